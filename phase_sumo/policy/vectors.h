// Rows of floats as vector registers: what the kernels of `scene_encoder.cpp` are made of.

#pragma once

#include <cstdint>
#include <cstring>
#include <utility>

constexpr int VECTOR = 16;
constexpr int whole(int count) { return (count + VECTOR - 1) / VECTOR * VECTOR; }

typedef float Vector __attribute__((vector_size(4 * VECTOR)));
typedef float Unaligned __attribute__((vector_size(4 * VECTOR), aligned(4), may_alias));
typedef int32_t Integers __attribute__((vector_size(4 * VECTOR)));

inline Vector load(const float *from) { return *reinterpret_cast<const Unaligned *>(from); }
inline void store(float *to, Vector v) { *reinterpret_cast<Unaligned *>(to) = v; }
inline Vector larger(Vector a, Vector b) { return a > b ? a : b; }
inline Vector smaller(Vector a, Vector b) { return a < b ? a : b; }

// term(0) + term(1) + ..., in four sums that do not wait for one another
template <int COUNT, class Term>
inline Vector total(Term term) {
    static_assert(COUNT % 4 == 0, "four sums");
    Vector part[4] = {};
    for (int i = 0; i < COUNT; i += 4)
#pragma GCC unroll 4
        for (int j = 0; j < 4; j++) part[j] += term(i + j);
    return (part[0] + part[1]) + (part[2] + part[3]);
}

template <int S, int... J>
inline Vector rotated(Vector v, std::integer_sequence<int, J...>) {
    return __builtin_shufflevector(v, v, ((J + S) % VECTOR)...);
}
template <int S>
inline Vector rotated(Vector v) { return rotated<S>(v, std::make_integer_sequence<int, VECTOR>()); }

inline float sum(Vector v) {
    v += rotated<8>(v), v += rotated<4>(v), v += rotated<2>(v), v += rotated<1>(v);
    return v[0];
}

inline float largest(Vector v) {
    v = larger(v, rotated<8>(v)), v = larger(v, rotated<4>(v));
    v = larger(v, rotated<2>(v)), v = larger(v, rotated<1>(v));
    return v[0];
}

// e^x for -60 <= x <= 0, and e^-60 below: 2^n times a polynomial of the rest, relative error below 2e-7
inline Vector exponential(Vector x) {
    x = larger(x, Vector{} - 60.0f);
    Integers exponent = __builtin_convertvector(x * 1.44269504f - 0.5f, Integers);  // rounds, as x <= 0
    Vector n = __builtin_convertvector(exponent, Vector);
    Vector f = x - n * 0.693359375f + n * 2.12194440e-4f;
    Vector p = 1.9875691500e-4f * f + 1.3981999507e-3f;
    p = p * f + 8.3334519073e-3f;
    p = p * f + 4.1665795894e-2f;
    p = p * f + 1.6666665459e-1f;
    p = p * f + 5.0000001201e-1f;
    p = p * f * f + f + 1.0f;
    return reinterpret_cast<Vector>(reinterpret_cast<Integers>(p) + (exponent << 23));
}

// one step of a transposition: blocks of S x S change places between rows i and i + S
template <int S, int... J>
inline void exchange(Vector &a, Vector &b, std::integer_sequence<int, J...>) {
    Vector upper = __builtin_shufflevector(a, b, ((J & S) ? VECTOR + J - S : J)...);
    b = __builtin_shufflevector(a, b, ((J & S) ? VECTOR + J : J + S)...);
    a = upper;
}

template <int S>
inline void exchange_rows(Vector *rows) {
#pragma GCC unroll 16
    for (int i = 0; i < VECTOR; i++)
        if (!(i & S)) exchange<S>(rows[i], rows[i + S], std::make_integer_sequence<int, VECTOR>());
}

// B[N][WIDE] = A[M][N]^T, zeros beyond M; a row of A every STRIDE numbers
template <int M, int N, int WIDE = M, int STRIDE = N>
inline void transpose(const float *a, float *b) {
    for (int m = 0; m < WIDE; m += VECTOR)
        for (int n = 0; n < N; n += VECTOR) {
            Vector rows[VECTOR];
#pragma GCC unroll 16
            for (int i = 0; i < VECTOR; i++) rows[i] = m + i < M ? load(a + (m + i) * STRIDE + n) : Vector{};
            exchange_rows<8>(rows), exchange_rows<4>(rows), exchange_rows<2>(rows), exchange_rows<1>(rows);
#pragma GCC unroll 16
            for (int i = 0; i < VECTOR; i++) store(b + (n + i) * WIDE + m, rows[i]);
        }
}

template <int COUNT>
inline void clear(float *a) { std::memset(a, 0, sizeof(float) * COUNT); }

template <int COUNT>
inline void add(const float *a, float *b) {
    for (int i = 0; i < COUNT; i += VECTOR) store(b + i, load(b + i) + load(a + i));
}

template <int COUNT>
inline void rectify(const float *a, float *b) {
    for (int i = 0; i < COUNT; i += VECTOR) store(b + i, larger(load(a + i), Vector{}));
}

template <int COUNT>
inline void rectify_backward(const float *a, float *grad) {
    for (int i = 0; i < COUNT; i += VECTOR) store(grad + i, load(a + i) > 0.0f ? load(grad + i) : Vector{});
}

// the FEATURES rows of x to mean 0 and variance 1, lane by lane; scale[L] is what they were multiplied by
template <int FEATURES, int L>
inline void normalise(const float *x, float *y, float *scale) {
    for (int l = 0; l < L; l += VECTOR) {
        const Vector mean = total<FEATURES>([&](int f) { return load(x + f * L + l); }) / float(FEATURES);
        const Vector square = total<FEATURES>([&](int f) {
            Vector centred = load(x + f * L + l) - mean;
            return centred * centred;
        });
        for (int i = 0; i < VECTOR; i++) scale[l + i] = 1.0f / __builtin_sqrtf(square[i] / FEATURES + 1e-5f);
        const Vector factor = load(scale + l);
        for (int f = 0; f < FEATURES; f++) store(y + f * L + l, (load(x + f * L + l) - mean) * factor);
    }
}

// gradient of y to that of x; ADD: to what is there already
template <int FEATURES, int L, bool ADD>
inline void normalise_backward(const float *y, const float *scale, const float *grad_y, float *grad_x) {
    for (int l = 0; l < L; l += VECTOR) {
        const Vector mean = total<FEATURES>([&](int f) { return load(grad_y + f * L + l); }) / float(FEATURES);
        const Vector along = total<FEATURES>([&](int f) { return load(grad_y + f * L + l) * load(y + f * L + l); }) /
                             float(FEATURES);
        const Vector factor = load(scale + l);
        for (int f = 0; f < FEATURES; f++) {
            const int at = f * L + l;
            Vector grad = (load(grad_y + at) - mean - load(y + at) * along) * factor;
            store(grad_x + at, ADD ? load(grad_x + at) + grad : grad);
        }
    }
}

enum Start { FROM_ZERO, FROM_C, FROM_BIAS };  // what the sums of a matrix product begin with
