// Matrix products of small matrices in fp32, for any processor.

#pragma once

#include "vectors.h"

constexpr int AGENTS = 1;  // that share registers

inline bool ready() { return true; }

struct Products {  // what a thread holds while it multiplies
    ~Products() {}
};

// C[M][N] = start + A[M][K] B[K][N], where A(m, k) lies at a[m * AM + k * AK], a row of B every BS, of C every CS
// numbers: transposing A costs nothing. START says whether sums begin with 0, C or bias[M][VECTOR].
template <Start START, int M, int K, int N, int AM, int AK, int BS = N, int CS = N>
inline void multiply(const float *a, const float *b, float *c, const float *bias = nullptr) {
    constexpr int ROWS = M % 8 == 0 ? 8 : (M % 4 == 0 ? 4 : 1), COLUMNS = N % (2 * VECTOR) == 0 ? 2 : 1;
    static_assert(N % VECTOR == 0, "whole vectors only");
    for (int n = 0; n < N; n += COLUMNS * VECTOR)
        for (int m = 0; m < M; m += ROWS) {
            Vector total[ROWS][COLUMNS] = {};
#pragma GCC unroll 8
            for (int i = 0; i < ROWS; i++)
#pragma GCC unroll 2
                for (int j = 0; j < COLUMNS; j++) {
                    if (START == FROM_C) total[i][j] = load(c + (m + i) * CS + n + j * VECTOR);
                    if (START == FROM_BIAS) total[i][j] = load(bias + (m + i) * VECTOR);
                }
            for (int k = 0; k < K; k++) {
                Vector row[COLUMNS];
#pragma GCC unroll 2
                for (int j = 0; j < COLUMNS; j++) row[j] = load(b + k * BS + n + j * VECTOR);
#pragma GCC unroll 8
                for (int i = 0; i < ROWS; i++) {
                    float factor = a[(m + i) * AM + k * AK];
#pragma GCC unroll 2
                    for (int j = 0; j < COLUMNS; j++) total[i][j] += factor * row[j];
                }
            }
#pragma GCC unroll 8
            for (int i = 0; i < ROWS; i++)
#pragma GCC unroll 2
                for (int j = 0; j < COLUMNS; j++) store(c + (m + i) * CS + n + j * VECTOR, total[i][j]);
        }
}

// the same with B^T for B[N][K], and for A[M][K] with a row every AS numbers
template <Start START, int M, int K, int N, int AS = K, int BS = K, int CS = whole(N)>
inline void multiply_turned(const float *a, const float *b, float *c) {
    alignas(64) float turned[K * whole(N)];
    transpose<N, K, whole(N), BS>(b, turned);
    multiply<START, M, K, whole(N), AS, 1, whole(N), CS>(a, turned, c);
}

// a layer's matrix [O][I], made ready once for many products
template <int O, int I>
struct Matrix {
    const float *weight;

    void prepare(const float *from) { weight = from; }

    template <int L>
    void times(const float *x, float *y, const float *bias) const {  // y[O][L] = bias + W x[I][L]
        multiply<FROM_BIAS, O, I, L, I, 1>(weight, x, y, bias);
    }

    template <Start START, int L>
    void turned_times(const float *x, float *y) const {  // y[I][L] = start + W^T x[O][L]
        multiply<START, I, O, L, 1, I>(weight, x, y);
    }
};
