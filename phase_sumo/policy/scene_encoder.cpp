// SceneEncoder (scene_encoder.py) for one agent after another, forward and backward, in fp32.
//
// An agent's partners and road points are the lanes of vector registers: every feature is a row of
// PARTNERS or POINTS numbers, all matrices are small, sizes are known when this is compiled, and nothing
// but features and results leaves the first cache levels. The backward pass works the forward pass out again
// instead of keeping it. Weights come as one array, layer by layer as in the module, a bias after its matrix;
// so do their gradients.

#include <cstdint>
#include <cstring>
#include <utility>

namespace {

constexpr int VECTOR = 16;
typedef float Vector __attribute__((vector_size(4 * VECTOR)));
typedef float Unaligned __attribute__((vector_size(4 * VECTOR), aligned(4)));
typedef int32_t Integers __attribute__((vector_size(4 * VECTOR)));

constexpr int SIZE = WIDTH / HEADS;                       // of a head
constexpr int KEY = 0, VALUE = WIDTH, SCORE = 2 * WIDTH;  // rows of what a road point gives
constexpr int GIVEN = 2 * WIDTH + SEEDS;

inline Vector load(const float *from) { return *reinterpret_cast<const Unaligned *>(from); }
inline void store(float *to, Vector v) { *reinterpret_cast<Unaligned *>(to) = v; }
inline Vector larger(Vector a, Vector b) { return a > b ? a : b; }

inline float sum(Vector v) {
    float total = 0;
    for (int i = 0; i < VECTOR; i++) total += v[i];
    return total;
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

// C[M][N] += A[M][K] B[K][N], where A(m, k) lies at a[m * AM + k * AK]: transposing A costs nothing
template <int M, int K, int N, int AM, int AK>
inline void multiply(const float *a, const float *b, float *c) {
    constexpr int ROWS = M % 8 == 0 ? 8 : (M % 4 == 0 ? 4 : 1), COLUMNS = N % (2 * VECTOR) == 0 ? 2 : 1;
    static_assert(N % VECTOR == 0, "whole vectors only");
    for (int n = 0; n < N; n += COLUMNS * VECTOR)
        for (int m = 0; m < M; m += ROWS) {
            Vector total[ROWS][COLUMNS];
#pragma GCC unroll 8
            for (int i = 0; i < ROWS; i++)
#pragma GCC unroll 2
                for (int j = 0; j < COLUMNS; j++) total[i][j] = load(c + (m + i) * N + n + j * VECTOR);
            for (int k = 0; k < K; k++) {
                Vector row[COLUMNS];
#pragma GCC unroll 2
                for (int j = 0; j < COLUMNS; j++) row[j] = load(b + k * N + n + j * VECTOR);
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
                for (int j = 0; j < COLUMNS; j++) store(c + (m + i) * N + n + j * VECTOR, total[i][j]);
        }
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

// B[N][WIDE] = A[M][N]^T, zeros beyond M
template <int M, int N, int WIDE = M>
inline void transpose(const float *a, float *b) {
    for (int m = 0; m < WIDE; m += VECTOR)
        for (int n = 0; n < N; n += VECTOR) {
            Vector rows[VECTOR];
#pragma GCC unroll 16
            for (int i = 0; i < VECTOR; i++) rows[i] = m + i < M ? load(a + (m + i) * N + n) : Vector{};
            exchange_rows<8>(rows), exchange_rows<4>(rows), exchange_rows<2>(rows), exchange_rows<1>(rows);
#pragma GCC unroll 16
            for (int i = 0; i < VECTOR; i++) store(b + (n + i) * WIDE + m, rows[i]);
        }
}

template <int COUNT>
inline void clear(float *a) { std::memset(a, 0, sizeof(float) * COUNT); }

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
        Vector mean = {}, square = {};
        for (int f = 0; f < FEATURES; f++) mean += load(x + f * L + l);
        mean /= float(FEATURES);
        for (int f = 0; f < FEATURES; f++) {
            Vector centred = load(x + f * L + l) - mean;
            square += centred * centred;
        }
        for (int i = 0; i < VECTOR; i++) scale[l + i] = 1.0f / __builtin_sqrtf(square[i] / FEATURES + 1e-5f);
        for (int f = 0; f < FEATURES; f++) store(y + f * L + l, (load(x + f * L + l) - mean) * load(scale + l));
    }
}

// gradient of y to that of x; ADD: to what is there already
template <int FEATURES, int L, bool ADD>
inline void normalise_backward(const float *y, const float *scale, const float *grad_y, float *grad_x) {
    for (int l = 0; l < L; l += VECTOR) {
        Vector mean = {}, along = {};
        for (int f = 0; f < FEATURES; f++) {
            mean += load(grad_y + f * L + l);
            along += load(grad_y + f * L + l) * load(y + f * L + l);
        }
        mean /= float(FEATURES), along /= float(FEATURES);
        for (int f = 0; f < FEATURES; f++) {
            const int at = f * L + l;
            Vector grad = (load(grad_y + at) - mean - load(y + at) * along) * load(scale + l);
            store(grad_x + at, ADD ? load(grad_x + at) + grad : grad);
        }
    }
}

template <int O, int I>
struct Linear {
    static constexpr int COUNT = O * I + O;

    template <int L>
    static void forward(const float *weight, const float *x, float *y) {
        for (int o = 0; o < O; o++)
            for (int l = 0; l < L; l += VECTOR) store(y + o * L + l, Vector{} + weight[O * I + o]);
        multiply<O, I, L, I, 1>(weight, x, y);
    }

    template <int L>
    static void backward(const float *x, const float *grad_y, float *grad_weight) {
        constexpr int WHOLE = (I + VECTOR - 1) / VECTOR * VECTOR;
        alignas(64) float turned[L * WHOLE], grad[O * WHOLE];
        transpose<I, L, WHOLE>(x, turned);
        if constexpr (WHOLE == I) {
            multiply<O, L, I, L, 1>(grad_y, turned, grad_weight);
        } else {
            clear<O * WHOLE>(grad);
            multiply<O, L, WHOLE, L, 1>(grad_y, turned, grad);
            for (int o = 0; o < O; o++)
                for (int i = 0; i < I; i++) grad_weight[o * I + i] += grad[o * WHOLE + i];
        }
        for (int o = 0; o < O; o++) {
            Vector total = {};
            for (int l = 0; l < L; l += VECTOR) total += load(grad_y + o * L + l);
            grad_weight[O * I + o] += sum(total);
        }
    }

    template <int L>
    static void backward_input(const float *weight, const float *grad_y, float *grad_x) {  // adds
        multiply<I, O, L, 1, I>(weight, grad_y, grad_x);
    }
};

using Partner1 = Linear<HIDDEN, PARTNER_FEATURES>;
using Partner2 = Linear<WIDTH, HIDDEN>;
using Road1 = Linear<HIDDEN, ROAD_FEATURES>;
using Road2 = Linear<GIVEN, HIDDEN>;
using Query = Linear<WIDTH, WIDTH>;
using Out = Linear<WIDTH, WIDTH>;
using Feed1 = Linear<FEEDFORWARD, WIDTH>;
using Feed2 = Linear<WIDTH, FEEDFORWARD>;
using Score = Linear<SEEDS, WIDTH>;

constexpr int PARTNER1 = 0, PARTNER2 = PARTNER1 + Partner1::COUNT, ROAD1 = PARTNER2 + Partner2::COUNT,
              ROAD2 = ROAD1 + Road1::COUNT, QUERY = ROAD2 + Road2::COUNT, OUT = QUERY + Query::COUNT,
              FEED1 = OUT + Out::COUNT, FEED2 = FEED1 + Feed1::COUNT, SCORES = FEED2 + Feed2::COUNT,
              WEIGHTS = SCORES + Score::COUNT;

// rows of scores to weights e^s / (1 + sum e^s) over the L lanes where mask holds
template <int L>
inline void pool_weights(float *score, const uint8_t *mask) {
    for (int s = 0; s < SEEDS; s++) {
        float *row = score + s * L;
        float most = 0, total = 0;
        for (int l = 0; l < L; l++)
            if (mask[l] && row[l] > most) most = row[l];
        for (int l = 0; l < L; l += VECTOR) store(row + l, exponential(load(row + l) - most));
        for (int l = 0; l < L; l++) {
            row[l] = mask[l] ? row[l] : 0.0f;
            total += row[l];
        }
        float scale = 1.0f / (total + exponential(Vector{} - most)[0]);
        for (int l = 0; l < L; l += VECTOR) store(row + l, load(row + l) * scale);
    }
}

// pooled[S][WIDTH] = weight[S][L] values[WIDTH][L]^T
template <int L>
inline void pool(const float *weight, const float *values, float *pooled) {
    alignas(64) float turned[L * WIDTH];
    transpose<WIDTH, L>(values, turned);
    clear<SEEDS * WIDTH>(pooled);
    multiply<SEEDS, L, WIDTH, L, 1>(weight, turned, pooled);
}

// gradients of scores and values (added) from that of pooled
template <int L>
inline void pool_backward(const float *weight, const float *values, const float *grad_pooled, float *grad_score,
                          float *grad_values) {
    clear<SEEDS * L>(grad_score);
    multiply<SEEDS, WIDTH, L, WIDTH, 1>(grad_pooled, values, grad_score);
    multiply<WIDTH, SEEDS, L, 1, WIDTH>(grad_pooled, weight, grad_values);
    for (int s = 0; s < SEEDS; s++) {
        Vector total = {};
        for (int l = 0; l < L; l += VECTOR) total += load(weight + s * L + l) * load(grad_score + s * L + l);
        float mean = sum(total);
        for (int l = 0; l < L; l += VECTOR)
            store(grad_score + s * L + l, load(weight + s * L + l) * (load(grad_score + s * L + l) - mean));
    }
}

struct Agent {
    alignas(64) float road_normal[HIDDEN * POINTS], road_scale[POINTS];
    alignas(64) float road_hidden[HIDDEN * POINTS];
    alignas(64) float road[GIVEN * POINTS];  // keys, values, pooling weights
    alignas(64) float partner_normal[HIDDEN * PARTNERS], partner_scale[PARTNERS];
    alignas(64) float partner_hidden[HIDDEN * PARTNERS];
    alignas(64) float partner[WIDTH * PARTNERS];
    alignas(64) float query[WIDTH * PARTNERS];
    alignas(64) float attention[HEADS * POINTS * PARTNERS];
    alignas(64) float attended[WIDTH * PARTNERS];
    alignas(64) float informed[WIDTH * PARTNERS];
    alignas(64) float informed_normal[WIDTH * PARTNERS], informed_scale[PARTNERS];
    alignas(64) float feed[FEEDFORWARD * PARTNERS];
    alignas(64) float fused[WIDTH * PARTNERS];
    alignas(64) float fused_normal[WIDTH * PARTNERS], fused_scale[PARTNERS];
    alignas(64) float weight[SEEDS * PARTNERS];

    void attend(const uint8_t *road_mask) {
        const float scale = 1.0f / __builtin_sqrtf(SIZE);
        clear<WIDTH * PARTNERS>(attended);
        clear<HEADS * POINTS * PARTNERS>(attention);
        for (int h = 0; h < HEADS; h++) {
            float *p = attention + h * POINTS * PARTNERS;
            const int rows = h * SIZE;
            multiply<POINTS, SIZE, PARTNERS, 1, POINTS>(road + (KEY + rows) * POINTS, query + rows * PARTNERS, p);
            for (int l = 0; l < PARTNERS; l += VECTOR) {
                Vector most = {}, total;
                for (int r = 0; r < POINTS; r++)
                    if (road_mask[r]) most = larger(most, load(p + r * PARTNERS + l));
                total = exponential(-most * scale);
                for (int r = 0; r < POINTS; r++) {
                    Vector e = {};
                    if (road_mask[r]) e = exponential((load(p + r * PARTNERS + l) - most) * scale);
                    store(p + r * PARTNERS + l, e);
                    total += e;
                }
                for (int r = 0; r < POINTS; r++) store(p + r * PARTNERS + l, load(p + r * PARTNERS + l) / total);
            }
            multiply<SIZE, POINTS, PARTNERS, POINTS, 1>(road + (VALUE + rows) * POINTS, p, attended + rows * PARTNERS);
        }
    }

    void forward(const float *w, const float *partners, const uint8_t *partner_mask, const float *points,
                 const uint8_t *road_mask, float *pooled) {
        Road1::forward<POINTS>(w + ROAD1, points, road_hidden);
        normalise<HIDDEN, POINTS>(road_hidden, road_normal, road_scale);
        rectify<HIDDEN * POINTS>(road_normal, road_hidden);
        Road2::forward<POINTS>(w + ROAD2, road_hidden, road);
        Partner1::forward<PARTNERS>(w + PARTNER1, partners, partner_hidden);
        normalise<HIDDEN, PARTNERS>(partner_hidden, partner_normal, partner_scale);
        rectify<HIDDEN * PARTNERS>(partner_normal, partner_hidden);
        Partner2::forward<PARTNERS>(w + PARTNER2, partner_hidden, partner);
        Query::forward<PARTNERS>(w + QUERY, partner, query);
        attend(road_mask);
        Out::forward<PARTNERS>(w + OUT, attended, informed);
        for (int i = 0; i < WIDTH * PARTNERS; i++) informed[i] += partner[i];
        normalise<WIDTH, PARTNERS>(informed, informed_normal, informed_scale);
        Feed1::forward<PARTNERS>(w + FEED1, informed_normal, feed);
        rectify<FEEDFORWARD * PARTNERS>(feed, feed);
        Feed2::forward<PARTNERS>(w + FEED2, feed, fused);
        for (int i = 0; i < WIDTH * PARTNERS; i++) fused[i] += informed[i];
        normalise<WIDTH, PARTNERS>(fused, fused_normal, fused_scale);
        Score::forward<PARTNERS>(w + SCORES, fused_normal, weight);
        pool_weights<PARTNERS>(weight, partner_mask);
        pool<PARTNERS>(weight, fused, pooled);
        pool_weights<POINTS>(road + SCORE * POINTS, road_mask);
        pool<POINTS>(road + SCORE * POINTS, road + VALUE * POINTS, pooled + SEEDS * WIDTH);
    }

    // gradient of the queries, and of keys and values into grad_road
    void attend_backward(const float *grad_attended, float *grad_query, float *grad_road) const {
        alignas(64) float grad[POINTS * PARTNERS], turned[PARTNERS * POINTS];
        const float scale = 1.0f / __builtin_sqrtf(SIZE);
        clear<WIDTH * PARTNERS>(grad_query);
        for (int h = 0; h < HEADS; h++) {
            const float *p = attention + h * POINTS * PARTNERS;
            const int rows = h * SIZE;
            const float *grad_out = grad_attended + rows * PARTNERS;
            transpose<POINTS, PARTNERS>(p, turned);
            multiply<SIZE, PARTNERS, POINTS, PARTNERS, 1>(grad_out, turned, grad_road + (VALUE + rows) * POINTS);
            clear<POINTS * PARTNERS>(grad);
            multiply<POINTS, SIZE, PARTNERS, 1, POINTS>(road + (VALUE + rows) * POINTS, grad_out, grad);
            for (int l = 0; l < PARTNERS; l += VECTOR) {
                Vector mean = {};
                for (int r = 0; r < POINTS; r++)
                    mean += load(p + r * PARTNERS + l) * load(grad + r * PARTNERS + l);
                for (int r = 0; r < POINTS; r++) {
                    const int at = r * PARTNERS + l;
                    store(grad + at, load(p + at) * (load(grad + at) - mean) * scale);
                }
            }
            multiply<SIZE, POINTS, PARTNERS, POINTS, 1>(road + (KEY + rows) * POINTS, grad, grad_query + rows * PARTNERS);
            transpose<POINTS, PARTNERS>(grad, turned);
            multiply<SIZE, PARTNERS, POINTS, PARTNERS, 1>(query + rows * PARTNERS, turned, grad_road + (KEY + rows) * POINTS);
        }
    }

    void backward(const float *w, const float *partners, const float *points, const float *grad_pooled,
                  float *grad) const {
        alignas(64) float grad_road[GIVEN * POINTS], grad_hidden[HIDDEN * POINTS], grad_feed[FEEDFORWARD * PARTNERS];
        alignas(64) float grad_fused[WIDTH * PARTNERS], grad_score[SEEDS * PARTNERS], grad_query[WIDTH * PARTNERS];
        alignas(64) float grad_attended[WIDTH * PARTNERS], grad_normal[WIDTH * PARTNERS];
        clear<GIVEN * POINTS>(grad_road);
        pool_backward<POINTS>(road + SCORE * POINTS, road + VALUE * POINTS, grad_pooled + SEEDS * WIDTH,
                              grad_road + SCORE * POINTS, grad_road + VALUE * POINTS);
        clear<WIDTH * PARTNERS>(grad_fused);
        pool_backward<PARTNERS>(weight, fused, grad_pooled, grad_score, grad_fused);
        Score::backward<PARTNERS>(fused_normal, grad_score, grad + SCORES);
        clear<WIDTH * PARTNERS>(grad_normal);
        Score::backward_input<PARTNERS>(w + SCORES, grad_score, grad_normal);
        normalise_backward<WIDTH, PARTNERS, true>(fused_normal, fused_scale, grad_normal, grad_fused);
        Feed2::backward<PARTNERS>(feed, grad_fused, grad + FEED2);
        clear<FEEDFORWARD * PARTNERS>(grad_feed);
        Feed2::backward_input<PARTNERS>(w + FEED2, grad_fused, grad_feed);
        rectify_backward<FEEDFORWARD * PARTNERS>(feed, grad_feed);
        Feed1::backward<PARTNERS>(informed_normal, grad_feed, grad + FEED1);
        clear<WIDTH * PARTNERS>(grad_normal);
        Feed1::backward_input<PARTNERS>(w + FEED1, grad_feed, grad_normal);
        // from here on grad_fused is the gradient of informed
        normalise_backward<WIDTH, PARTNERS, true>(informed_normal, informed_scale, grad_normal, grad_fused);
        Out::backward<PARTNERS>(attended, grad_fused, grad + OUT);
        clear<WIDTH * PARTNERS>(grad_attended);
        Out::backward_input<PARTNERS>(w + OUT, grad_fused, grad_attended);
        attend_backward(grad_attended, grad_query, grad_road);
        Query::backward<PARTNERS>(partner, grad_query, grad + QUERY);
        Query::backward_input<PARTNERS>(w + QUERY, grad_query, grad_fused);  // now that of partner
        Partner2::backward<PARTNERS>(partner_hidden, grad_fused, grad + PARTNER2);
        clear<HIDDEN * PARTNERS>(grad_hidden);
        Partner2::backward_input<PARTNERS>(w + PARTNER2, grad_fused, grad_hidden);
        rectify_backward<HIDDEN * PARTNERS>(partner_hidden, grad_hidden);
        normalise_backward<HIDDEN, PARTNERS, false>(partner_normal, partner_scale, grad_hidden, grad_hidden);
        Partner1::backward<PARTNERS>(partners, grad_hidden, grad + PARTNER1);
        Road2::backward<POINTS>(road_hidden, grad_road, grad + ROAD2);
        clear<HIDDEN * POINTS>(grad_hidden);
        Road2::backward_input<POINTS>(w + ROAD2, grad_road, grad_hidden);
        rectify_backward<HIDDEN * POINTS>(road_hidden, grad_hidden);
        normalise_backward<HIDDEN, POINTS, false>(road_normal, road_scale, grad_hidden, grad_hidden);
        Road1::backward<POINTS>(points, grad_hidden, grad + ROAD1);
    }
};

constexpr int PARTNER_STRIDE = PARTNER_FEATURES * PARTNERS, ROAD_STRIDE = ROAD_FEATURES * POINTS,
              POOLED_STRIDE = 2 * SEEDS * WIDTH;

}  // namespace

extern "C" int weight_count() { return WEIGHTS; }
extern "C" int pooled_count() { return POOLED_STRIDE; }

// partner [count][features][partners], masks one byte an element, pooled [count][2][seeds][width]
extern "C" void forward(int64_t count, int threads, const float *weights, const float *partner,
                        const uint8_t *partner_mask, const float *road, const uint8_t *road_mask, float *pooled) {
#pragma omp parallel num_threads(threads)
    {
        Agent agent;
#pragma omp for
        for (int64_t i = 0; i < count; i++)
            agent.forward(weights, partner + i * PARTNER_STRIDE, partner_mask + i * PARTNERS, road + i * ROAD_STRIDE,
                          road_mask + i * POINTS, pooled + i * POOLED_STRIDE);
    }
}

// adds to grad [threads][weight_count()]; even parts of the agents, so that a number of threads fixes the result
extern "C" void backward(int64_t count, int threads, const float *weights, const float *partner,
                         const uint8_t *partner_mask, const float *road, const uint8_t *road_mask,
                         const float *grad_pooled, float *grad) {
#pragma omp parallel for num_threads(threads)
    for (int thread = 0; thread < threads; thread++) {
        Agent agent;
        alignas(64) float pooled[POOLED_STRIDE];
        for (int64_t i = count * thread / threads; i < count * (thread + 1) / threads; i++) {
            const float *partners = partner + i * PARTNER_STRIDE, *points = road + i * ROAD_STRIDE;
            agent.forward(weights, partners, partner_mask + i * PARTNERS, points, road_mask + i * POINTS, pooled);
            agent.backward(weights, partners, points, grad_pooled + i * POOLED_STRIDE, grad + thread * WEIGHTS);
        }
    }
}
