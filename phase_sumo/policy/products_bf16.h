// Matrix products of small matrices with factors rounded to bf16 and sums in fp32, on the tiles of AMX.
//
// The left factor of a product lies in "rows", [M][K], the right one in "pairs", [K / 2][N][2]; M and N are
// filled up with zeros to whole tiles of 16, K of 32. Pairs seen as 32-bit numbers and transposed are the rows
// of the transposed matrix, and the other way round. C has to have room for M filled up to whole tiles.

#pragma once

#include <immintrin.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "vectors.h"

constexpr int AGENTS = 2;  // that share registers
constexpr int DEPTH = 32;  // of a tile: numbers that one instruction multiplies and adds up
constexpr int deep(int k) { return (k + DEPTH - 1) / DEPTH * DEPTH; }

// Linux gives a process tiles on request
inline bool ready() { return syscall(SYS_arch_prctl, 0x1023, 18) == 0; }

// eight tiles of 16 rows of 64 bytes, for as long as this lives; what the thread had before comes back
struct Products {
    struct alignas(64) Layout {
        uint8_t palette = 1, start = 0, unused[14] = {};
        uint16_t bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
        uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
    };
    Layout before;

    Products() {
        Layout layout;
        asm volatile("sttilecfg %0" : "=m"(before));
        asm volatile("ldtilecfg %0" ::"m"(layout));
    }
    ~Products() { asm volatile("ldtilecfg %0" ::"m"(before)); }
};

#define TILE_LOAD(tile, from, stride) \
    asm volatile("tileloadd (%0,%1,1), %%tmm" #tile ::"r"(from), "r"(int64_t(stride)) : "memory")
#define TILE_ZERO(tile) asm volatile("tilezero %%tmm" #tile ::)
#define TILE_STORE(tile, to, stride) \
    asm volatile("tilestored %%tmm" #tile ", (%0,%1,1)" ::"r"(to), "r"(int64_t(stride)) : "memory")
#define TILE_MULTIPLY(c, a, b) asm volatile("tdpbf16ps %%tmm" #b ", %%tmm" #a ", %%tmm" #c ::)

// ROWS x COLUMNS tiles of C[][CS] = start + A[][K] B[K][BS]
template <Start START, int ROWS, int COLUMNS, int K, int BS, int CS>
inline void multiply_tiles(const uint16_t *a, const uint32_t *b, float *c, const float *bias) {
    constexpr int NEXT = VECTOR * CS;
    if constexpr (START == FROM_ZERO) {
        TILE_ZERO(0);
        if constexpr (COLUMNS == 2) TILE_ZERO(1);
        if constexpr (ROWS == 2) TILE_ZERO(2);
        if constexpr (ROWS == 2 && COLUMNS == 2) TILE_ZERO(3);
    } else {
        constexpr int RIGHT = START == FROM_C ? VECTOR : 0, STRIDE = START == FROM_C ? CS : VECTOR;
        const float *start = START == FROM_C ? c : bias, *below = start + VECTOR * STRIDE;
        TILE_LOAD(0, start, 4 * STRIDE);
        if constexpr (COLUMNS == 2) TILE_LOAD(1, start + RIGHT, 4 * STRIDE);
        if constexpr (ROWS == 2) TILE_LOAD(2, below, 4 * STRIDE);
        if constexpr (ROWS == 2 && COLUMNS == 2) TILE_LOAD(3, below + RIGHT, 4 * STRIDE);
    }
#pragma GCC unroll 4
    for (int k = 0; k < K; k += DEPTH) {
        TILE_LOAD(4, a + k, 2 * K);
        TILE_LOAD(6, b + k / 2 * BS, 4 * BS);
        TILE_MULTIPLY(0, 4, 6);
        if constexpr (COLUMNS == 2) TILE_LOAD(7, b + k / 2 * BS + VECTOR, 4 * BS);
        if constexpr (COLUMNS == 2) TILE_MULTIPLY(1, 4, 7);
        if constexpr (ROWS == 2) TILE_LOAD(5, a + VECTOR * K + k, 2 * K);
        if constexpr (ROWS == 2) TILE_MULTIPLY(2, 5, 6);
        if constexpr (ROWS == 2 && COLUMNS == 2) TILE_MULTIPLY(3, 5, 7);
    }
    TILE_STORE(0, c, 4 * CS);
    if constexpr (COLUMNS == 2) TILE_STORE(1, c + VECTOR, 4 * CS);
    if constexpr (ROWS == 2) TILE_STORE(2, c + NEXT, 4 * CS);
    if constexpr (ROWS == 2 && COLUMNS == 2) TILE_STORE(3, c + NEXT + VECTOR, 4 * CS);
}

// C[whole(M)][N] = start + A B for rows a and pairs b, a row of C every CS numbers
template <Start START, int M, int K, int N, int CS>
inline void multiply_packed(const uint16_t *a, const uint32_t *b, float *c, const float *bias = nullptr) {
    static_assert(N % VECTOR == 0, "whole vectors only");
    constexpr int TILES = whole(M) / VECTOR, COLUMNS = N % (2 * VECTOR) == 0 ? 2 : 1;
    for (int n = 0; n < N; n += COLUMNS * VECTOR) {
        for (int m = 0; m + VECTOR < whole(M); m += 2 * VECTOR)
            multiply_tiles<START, 2, COLUMNS, deep(K), N, CS>(a + m * deep(K), b + n, c + m * CS + n, bias + m * VECTOR);
        if constexpr (TILES % 2 == 1) {
            constexpr int m = (TILES - 1) * VECTOR;
            multiply_tiles<START, 1, COLUMNS, deep(K), N, CS>(a + m * deep(K), b + n, c + m * CS + n, bias + m * VECTOR);
        }
    }
}

// 16 numbers of two rows as bf16, one behind the other
inline __m512i round_two(Vector first, Vector second) {
    return (__m512i)_mm512_cvtne2ps_pbh((__m512)second, (__m512)first);
}

inline Vector load_some(const float *from, int count) {  // zeros beyond
    const __mmask16 taken = count >= VECTOR ? 0xffff : count <= 0 ? 0 : (1 << count) - 1;
    return (Vector)_mm512_maskz_loadu_ps(taken, from);
}

// a[M][K], a row every STRIDE numbers, to rows
template <int M, int K, int STRIDE = K>
inline void to_rows(const float *a, uint16_t *rows) {
    for (int m = 0; m < whole(M); m++)
        for (int k = 0; k < deep(K); k += DEPTH) {
            const float *from = a + m * STRIDE + k;
            Vector first = load_some(from, m < M ? K - k : 0), second = load_some(from + VECTOR, m < M ? K - k - VECTOR : 0);
            *reinterpret_cast<__m512i *>(rows + m * deep(K) + k) = round_two(first, second);
        }
}

// b[K][N], a row every STRIDE numbers, to pairs
template <int K, int N, int STRIDE = N>
inline void to_pairs(const float *b, uint32_t *pairs) {
    alignas(64) static constexpr uint16_t ORDER[32] = {0, 16, 1, 17, 2,  18, 3,  19, 4,  20, 5,  21, 6,  22, 7,  23,
                                                       8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
    const __m512i order = *reinterpret_cast<const __m512i *>(ORDER);
    for (int k = 0; k < deep(K); k += 2)
        for (int n = 0; n < N; n += VECTOR) {
            Vector even = k < K ? load(b + k * STRIDE + n) : Vector{};
            Vector odd = k + 1 < K ? load(b + (k + 1) * STRIDE + n) : Vector{};
            *reinterpret_cast<__m512i *>(pairs + k / 2 * N + n) =
                _mm512_permutexvar_epi16(order, round_two(even, odd));
        }
}

template <int M, int N>
inline void transpose_bits(const void *from, void *to) {
    transpose<M, N>(static_cast<const float *>(from), static_cast<float *>(to));
}

// C[M][N] = start + A[M][K] B[K][N], where A(m, k) lies at a[m * AM + k * AK], a row of B every BS, of C every CS
// numbers
template <Start START, int M, int K, int N, int AM, int AK, int BS = N, int CS = N>
inline void multiply(const float *a, const float *b, float *c) {
    static_assert(AM == 1 || AK == 1, "rows or columns side by side");
    alignas(64) uint16_t rows[whole(M) * deep(K)];
    alignas(64) uint32_t pairs[deep(K) / 2 * N];
    if constexpr (AK == 1) {
        to_rows<M, K, AM>(a, rows);
    } else {
        alignas(64) uint32_t columns[deep(K) / 2 * M];
        to_pairs<K, M, AK>(a, columns);
        transpose_bits<deep(K) / 2, M>(columns, rows);
    }
    to_pairs<K, N, BS>(b, pairs);
    multiply_packed<START, M, K, N, CS>(rows, pairs, c);
}

// the same with B^T for B[N][K], and for A[M][K] with a row every AS numbers
template <Start START, int M, int K, int N, int AS = K, int BS = K, int CS = whole(N)>
inline void multiply_turned(const float *a, const float *b, float *c) {
    alignas(64) uint16_t rows[whole(M) * deep(K)], columns[whole(N) * deep(K)];
    alignas(64) uint32_t pairs[deep(K) / 2 * whole(N)];
    to_rows<M, K, AS>(a, rows);
    to_rows<N, K, BS>(b, columns);
    transpose_bits<whole(N), deep(K) / 2>(columns, pairs);
    multiply_packed<START, M, K, whole(N), CS>(rows, pairs, c);
}

// a layer's matrix [O][I], made ready once for many products
template <int O, int I>
struct Matrix {
    alignas(64) uint16_t rows[whole(O) * deep(I)], turned[whole(I) * deep(O)];

    void prepare(const float *weight) {
        alignas(64) float columns[I * O];
        for (int i = 0; i < I; i++)
            for (int o = 0; o < O; o++) columns[i * O + o] = weight[o * I + i];
        to_rows<O, I>(weight, rows);
        to_rows<I, O>(columns, turned);
    }

    template <int L>
    void times(const float *x, float *y, const float *bias) const {  // y[whole(O)][L] = bias + W x[I][L]
        alignas(64) uint32_t pairs[deep(I) / 2 * L];
        to_pairs<I, L>(x, pairs);
        multiply_packed<FROM_BIAS, O, I, L, L>(rows, pairs, y, bias);
    }

    template <Start START, int L>
    void turned_times(const float *x, float *y) const {  // y[whole(I)][L] = start + W^T x[O][L]
        alignas(64) uint32_t pairs[deep(O) / 2 * L];
        to_pairs<O, L>(x, pairs);
        multiply_packed<START, I, O, L, L>(turned, pairs, y);
    }
};
