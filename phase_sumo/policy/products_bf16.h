// Matrix products of small matrices with factors rounded to bf16 and sums in fp32, on the tiles of AMX.
//
// The left factor of a product lies in "rows", tiles of [16][32], row after row of tiles; the right one in "pairs",
// tiles of [16][16][2] with two rows of the matrix beside one another, column after column of tiles. Matrices are filled up with zeros to whole
// tiles. A tile of pairs seen as 32-bit numbers and transposed is a tile of rows of the transposed matrix, and the
// other way round. C is an ordinary matrix that has room for whole tiles.

#pragma once

#include <immintrin.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "vectors.h"

constexpr int AGENTS = 2;  // that share registers
constexpr int DEPTH = 32;  // of a tile: numbers that one instruction multiplies and adds up
constexpr int TILE = VECTOR * DEPTH;
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

// ROWS x COLUMNS tiles of C[][CS] = start + A[][K] B[K][] for rows a and pairs b
template <Start START, int ROWS, int COLUMNS, int K, int CS>
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
    for (int k = 0; k < K / DEPTH; k++) {
        TILE_LOAD(4, a + k * TILE, 64);
        TILE_LOAD(6, b + k * (TILE / 2), 64);
        TILE_MULTIPLY(0, 4, 6);
        if constexpr (COLUMNS == 2) TILE_LOAD(7, b + (K / DEPTH + k) * (TILE / 2), 64);
        if constexpr (COLUMNS == 2) TILE_MULTIPLY(1, 4, 7);
        if constexpr (ROWS == 2) TILE_LOAD(5, a + K / DEPTH * TILE + k * TILE, 64);
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
            multiply_tiles<START, 2, COLUMNS, deep(K), CS>(a + m * deep(K), b + n * deep(K) / 2, c + m * CS + n, bias + m * VECTOR);
        if constexpr (TILES % 2 == 1) {
            constexpr int m = (TILES - 1) * VECTOR;
            multiply_tiles<START, 1, COLUMNS, deep(K), CS>(a + m * deep(K), b + n * deep(K) / 2, c + m * CS + n, bias + m * VECTOR);
        }
    }
}

// where m, k of rows [.][K] and k, n of pairs [K][.] lie
constexpr int row_at(int m, int k, int K) {
    return (m / VECTOR * (K / DEPTH) + k / DEPTH) * TILE + m % VECTOR * DEPTH + k % DEPTH;
}
constexpr int pair_at(int k, int n, int K) {
    return (n / VECTOR * (K / DEPTH) + k / DEPTH) * (TILE / 2) + k % DEPTH / 2 * VECTOR + n % VECTOR;
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
            *reinterpret_cast<__m512i *>(rows + row_at(m, k, deep(K))) = round_two(first, second);
        }
}

// b[K][N], a row every STRIDE numbers, to pairs; columns from STRIDE on are zeros
template <int K, int N, int STRIDE = N>
inline void to_pairs(const float *b, uint32_t *pairs) {
    alignas(64) static constexpr uint16_t ORDER[32] = {0, 16, 1, 17, 2,  18, 3,  19, 4,  20, 5,  21, 6,  22, 7,  23,
                                                       8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
    const __m512i order = *reinterpret_cast<const __m512i *>(ORDER);
    for (int k = 0; k < deep(K); k += 2)
        for (int n = 0; n < N; n += VECTOR) {
            const int left = N > STRIDE ? STRIDE - n : VECTOR;  // of a row; zeros beyond it
            Vector even = k < K ? load_some(b + k * STRIDE + n, left) : Vector{};
            Vector odd = k + 1 < K ? load_some(b + (k + 1) * STRIDE + n, left) : Vector{};
            *reinterpret_cast<__m512i *>(pairs + pair_at(k, n, deep(K))) =
                _mm512_permutexvar_epi16(order, round_two(even, odd));
        }
}

// rows [M][N] to pairs along M
template <int M, int N>
inline void rows_to_pairs(const uint16_t *rows, uint32_t *pairs) {
    for (int m = 0; m < M; m += 2)
        for (int n = 0; n < N; n += VECTOR) {
            const uint16_t *at = rows + row_at(m, n, N);
            const __m512i low = _mm512_cvtepu16_epi32(*reinterpret_cast<const __m256i *>(at));
            const __m512i high = _mm512_cvtepu16_epi32(*reinterpret_cast<const __m256i *>(at + DEPTH));
            *reinterpret_cast<__m512i *>(pairs + pair_at(m, n, deep(M))) = _mm512_or_si512(low, _mm512_slli_epi32(high, 16));
        }
}

inline Vector widened(const uint16_t *from) {  // 16 numbers of bf16
    return (Vector)_mm512_slli_epi32(_mm512_cvtepu16_epi32(*reinterpret_cast<const __m256i *>(from)), 16);
}

// rows of a matrix [M][K] to pairs of its transpose, or pairs of [K][M] to rows of its transpose
template <int M, int K>
inline void turn_tiles(const void *from, void *to) {
    constexpr int SIZE = VECTOR * VECTOR;
    for (int at = 0; at < whole(M) * deep(K) / 2; at += SIZE)
        transpose<VECTOR, VECTOR>(static_cast<const float *>(from) + at, static_cast<float *>(to) + at);
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
        turn_tiles<M, K>(columns, rows);
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
    turn_tiles<N, K>(columns, pairs);
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
