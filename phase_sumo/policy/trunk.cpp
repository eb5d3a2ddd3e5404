// The trunk and its heads (network.py) for blocks of agents, forward and backward, with matrix products in bf16.
//
// Both heads are one layer of 2 HEAD after the trunk's and one of ACTIONS + 1, whose matrix has two blocks:
// out = W3 relu(W2 relu(W1 (g n(x) + h) + b1) + b2) + b3, with n(x) of mean 0 and variance 1. Agents are the rows of
// left factors. What the backward pass needs is kept in bf16, as the products had it.

#include <memory>

#include "products_bf16.h"

namespace {

constexpr int ROWS = 256;  // agents of a block: many, as a block's gradients are added to those in slower memory
constexpr int HEADS = 2 * HEAD, OUTPUTS = ACTIONS + 1;

// words of bf16: a row [deep(I)] for n(x), for the first and for the second hidden layer
constexpr int apart(int n) { return deep(n) + VECTOR; }  // between rows of floats: not all in the same part of the cache
constexpr int KEPT = deep(INPUTS) + deep(TRUNK) + deep(HEADS);

// a layer's matrix as right factor: of the forward pass [I][O], of the backward pass [O][I]
template <int O, int I>
struct Dense {
    alignas(64) uint32_t pairs[deep(O) * deep(I) / 2];
    alignas(64) float bias[deep(O)] = {};

    void take(const float *weight, bool forward) {
        static thread_local uint16_t rows[deep(O) * deep(I)];
        if (forward) {
            to_rows<O, I>(weight, rows);
            turn_tiles<deep(O), I>(rows, pairs);
        } else {
            to_pairs<O, deep(I), I>(weight, pairs);
        }
    }
};

template <int O, int I>
struct DenseGradient {
    alignas(64) float matrix[deep(O) * apart(I)] = {}, bias[deep(O)] = {};

    // for what the layer was given and gradients of its result, as rows
    void add(const uint16_t *given, const uint16_t *grad) {
        alignas(64) uint32_t columns[ROWS / 2 * deep(O)], pairs[ROWS / 2 * deep(I)];
        alignas(64) uint16_t turned[deep(O) * ROWS];
        rows_to_pairs<ROWS, deep(O)>(grad, columns);
        turn_tiles<deep(O), ROWS>(columns, turned);
        rows_to_pairs<ROWS, deep(I)>(given, pairs);
        multiply_packed<FROM_C, O, ROWS, deep(I), apart(I)>(turned, pairs, matrix);
    }

    float *give(float *grad) const {  // returns what follows
        for (int o = 0; o < O; o++) std::memcpy(grad + o * I, matrix + o * apart(I), sizeof(float) * I);
        std::memcpy(grad + O * I, bias, sizeof(float) * O);
        return grad + O * I + O;
    }
};

template <template <int, int> class Of>
struct Layers {
    Of<TRUNK, INPUTS> first;
    Of<HEADS, TRUNK> second;
    Of<OUTPUTS, HEADS> third;

    template <class Visit>
    void each(Visit visit) { visit(first), visit(second), visit(third); }
};

// the module's parameters in their order: a matrix and its bias each
enum { NORM, FIRST = 2, POLICY = 4, POLICY_OUT = 6, VALUE = 8, VALUE_OUT = 10 };

struct Network : Layers<Dense> {
    const float *norm, *norm_bias;

    void take(const float *const *weights, bool forward) {
        static thread_local float heads[HEADS * TRUNK], outputs[OUTPUTS * HEADS];
        norm = weights[NORM], norm_bias = weights[NORM + 1];
        first.take(weights[FIRST], forward);
        std::memcpy(first.bias, weights[FIRST + 1], sizeof(float) * TRUNK);
        for (int head = 0; head < 2; head++) {
            const float *const *w = weights + (head ? VALUE : POLICY);
            std::memcpy(heads + head * HEAD * TRUNK, w[0], sizeof(float) * HEAD * TRUNK);
            std::memcpy(second.bias + head * HEAD, w[1], sizeof(float) * HEAD);
        }
        second.take(heads, forward);
        for (int o = 0; o < ACTIONS; o++)
            std::memcpy(outputs + o * HEADS, weights[POLICY_OUT] + o * HEAD, sizeof(float) * HEAD);
        std::memcpy(outputs + ACTIONS * HEADS + HEAD, weights[VALUE_OUT], sizeof(float) * HEAD);
        third.take(outputs, forward);
        std::memcpy(third.bias, weights[POLICY_OUT + 1], sizeof(float) * ACTIONS);
        third.bias[ACTIONS] = *weights[VALUE_OUT + 1];
    }
};

constexpr int WIDE = deep(INPUTS);

struct Gradients : Layers<DenseGradient> {
    alignas(64) float norm[WIDE] = {}, norm_bias[WIDE] = {};

    // norm's two, then matrix and bias of every layer
    void give(float *grad) {
        std::memcpy(grad, norm, sizeof(float) * INPUTS);
        std::memcpy(grad + INPUTS, norm_bias, sizeof(float) * INPUTS);
        grad += 2 * INPUTS;
        each([&](auto &layer) { grad = layer.give(grad); });
    }
};

constexpr int count(int o, int i) { return o * i + o; }
constexpr int WEIGHTS = 2 * INPUTS + count(TRUNK, INPUTS) + count(HEADS, TRUNK) + count(OUTPUTS, HEADS);

// a[ROWS][K] b[K][N] for rows a and pairs b, 32 columns at a time: use(n, c[ROWS][PANEL]) takes those from n on
constexpr int PANEL = DEPTH + VECTOR;
template <int K, int N, class Use>
inline void by_panels(const uint16_t *a, const uint32_t *b, Use use) {
    alignas(64) float c[ROWS * PANEL];
    for (int n = 0; n < deep(N); n += DEPTH) {
        multiply_packed<FROM_ZERO, ROWS, K, DEPTH, PANEL>(a, b + n * deep(K) / 2, c);
        use(n, c);
    }
}

// y = relu(W x + b) as rows
template <int O, int I>
inline void rectified(const Dense<O, I> &layer, const uint16_t *x, uint16_t *y) {
    by_panels<I, O>(x, layer.pairs, [&](int n, const float *c) {
        const Vector first = load(layer.bias + n), second = load(layer.bias + n + VECTOR);
        for (int row = 0; row < ROWS; row++)
            *reinterpret_cast<__m512i *>(y + row_at(row, n, deep(O))) =
                round_two(larger(load(c + row * PANEL) + first, Vector{}),
                          larger(load(c + row * PANEL + VECTOR) + second, Vector{}));
    });
}

// gradient of a rectified layer's sums from that of what came of it, as rows; bias: sums over the agents
template <int O, int I>
inline void rectified_backward(const Dense<O, I> &next, const uint16_t *given, const uint16_t *grad_y, uint16_t *grad_x,
                               float *bias) {
    by_panels<O, I>(grad_y, next.pairs, [&](int n, const float *c) {
        Vector sums[2] = {};
        for (int row = 0; row < ROWS; row++) {
            const int at = row_at(row, n, deep(I));
            const __m512i value = *reinterpret_cast<const __m512i *>(given + at);
            const __mmask32 positive = _mm512_test_epi16_mask(value, value);  // relu gave more than 0
            Vector first = (Vector)_mm512_maskz_loadu_ps(positive, c + row * PANEL);
            Vector second = (Vector)_mm512_maskz_loadu_ps(positive >> VECTOR, c + row * PANEL + VECTOR);
            sums[0] += first, sums[1] += second;
            *reinterpret_cast<__m512i *>(grad_x + at) = round_two(first, second);
        }
        store(bias + n, load(bias + n) + sums[0]), store(bias + n + VECTOR, load(bias + n + VECTOR) + sums[1]);
    });
}

// what a row was moved and scaled by
struct Moments {
    float mean, scale;

    explicit Moments(const float *x) {  // [WIDE], zero beyond INPUTS
        Vector sums = {}, squares = {};
        for (int i = 0; i < WIDE; i += VECTOR) sums += load(x + i);
        mean = sum(sums) / INPUTS;
        for (int i = 0; i < WIDE; i += VECTOR) squares += (load(x + i) - mean) * (load(x + i) - mean);
        const float variance = (sum(squares) - (WIDE - INPUTS) * mean * mean) / INPUTS;
        scale = 1.0f / __builtin_sqrtf(variance + 1e-5f);
    }

    Vector normal(const float *x) const { return (load(x) - mean) * scale; }
};

// one block of agents, and what is kept of it
struct Block {
    uint16_t *input, *first, *second;

    explicit Block(uint16_t *kept) : input(kept), first(input + ROWS * deep(INPUTS)), second(first + ROWS * deep(TRUNK)) {}

    // x [count][INPUTS], out [count][OUTPUTS]
    void forward(const Network &net, int count, const float *x, float *out) const {
        alignas(64) float padded[WIDE] = {}, factor[WIDE] = {}, bias[WIDE] = {};
        std::memcpy(factor, net.norm, sizeof(float) * INPUTS), std::memcpy(bias, net.norm_bias, sizeof(float) * INPUTS);
        if (count < ROWS) std::memset(input, 0, sizeof(uint16_t) * ROWS * WIDE);
        for (int row = 0; row < count; row++) {
            std::memcpy(padded, x + row * INPUTS, sizeof(float) * INPUTS);
            const Moments moments(padded);
            auto given = [&](int i) { return moments.normal(padded + i) * load(factor + i) + load(bias + i); };
            for (int i = 0; i < WIDE; i += DEPTH)
                *reinterpret_cast<__m512i *>(input + row_at(row, i, WIDE)) = round_two(given(i), given(i + VECTOR));
        }
        rectified(net.first, input, first);
        rectified(net.second, first, second);
        by_panels<HEADS, OUTPUTS>(second, net.third.pairs, [&](int n, const float *c) {
            for (int row = 0; row < count; row++)
                for (int o = n; o < OUTPUTS && o < n + DEPTH; o++)
                    out[row * OUTPUTS + o] = c[row * PANEL + o - n] + net.third.bias[o];
        });
    }

    void backward(const Network &net, int count, const float *x, const float *grad_out, float *grad_x,
                  Gradients &sums) const {
        alignas(64) uint16_t grad3[ROWS * deep(OUTPUTS)], grad2[ROWS * deep(HEADS)], grad1[ROWS * deep(TRUNK)];
        alignas(64) float grad[ROWS * apart(INPUTS)], padded[ROWS * deep(OUTPUTS)] = {};
        for (int row = 0; row < count; row++)
            for (int o = 0; o < OUTPUTS; o++) {
                padded[row * deep(OUTPUTS) + o] = grad_out[row * OUTPUTS + o];
                sums.third.bias[o] += grad_out[row * OUTPUTS + o];
            }
        to_rows<ROWS, OUTPUTS, deep(OUTPUTS)>(padded, grad3);
        sums.third.add(second, grad3);
        rectified_backward(net.third, second, grad3, grad2, sums.second.bias);
        sums.second.add(first, grad2);
        rectified_backward(net.second, first, grad2, grad1, sums.first.bias);
        sums.first.add(input, grad1);
        multiply_packed<FROM_ZERO, ROWS, TRUNK, WIDE, apart(INPUTS)>(grad1, net.first.pairs, grad);
        for (int row = 0; row < count; row++)
            normalise_backward(net, x + row * INPUTS, grad + row * apart(INPUTS), grad_x + row * INPUTS, sums);
    }

    // gradient of x from that of g n(x) + h, [WIDE]
    static void normalise_backward(const Network &net, const float *x, float *grad, float *grad_x, Gradients &sums) {
        alignas(64) float padded[WIDE] = {}, factor[WIDE] = {};
        std::memcpy(padded, x, sizeof(float) * INPUTS), std::memcpy(factor, net.norm, sizeof(float) * INPUTS);
        const Moments moments(padded);
        Vector total = {}, along = {};
        for (int i = 0; i < WIDE; i += VECTOR) {
            const Vector normal = moments.normal(padded + i);
            store(sums.norm + i, load(sums.norm + i) + load(grad + i) * normal);
            store(sums.norm_bias + i, load(sums.norm_bias + i) + load(grad + i));
            const Vector inner = load(grad + i) * load(factor + i);
            store(grad + i, inner);
            total += inner, along += inner * normal;
        }
        const float mean = sum(total) / INPUTS, share = sum(along) / INPUTS;
        for (int i = 0; i < WIDE; i += VECTOR)
            store(padded + i, (load(grad + i) - mean - moments.normal(padded + i) * share) * moments.scale);
        std::memcpy(grad_x, padded, sizeof(float) * INPUTS);
    }
};

// memory of the calling thread, which lends it to those that help
inline Network &network() {
    static thread_local Network net;
    return net;
}

inline int64_t blocks(int64_t count) { return (count + ROWS - 1) / ROWS; }

}  // namespace

extern "C" bool is_ready() { return ready(); }
extern "C" int weight_count() { return WEIGHTS; }
extern "C" int64_t kept_count(int64_t count) { return blocks(count) * ROWS * KEPT; }  // words of 16 bits

// x [count][INPUTS] to out [count][OUTPUTS]; kept is what `backward` needs
extern "C" void forward(int64_t count, int threads, const float *const *weights, const float *x, uint16_t *kept,
                        float *out) {
    Network &net = network();
    net.take(weights, true);
#pragma omp parallel num_threads(threads)
    {
        Products products;
#pragma omp for
        for (int64_t i = 0; i < count; i += ROWS)
            Block(kept + i * KEPT).forward(net, count - i < ROWS ? count - i : ROWS, x + i * INPUTS, out + i * OUTPUTS);
    }
}

// grad [threads][weight_count()]; even parts of the blocks, so that a number of threads fixes the result
extern "C" void backward(int64_t count, int threads, const float *const *weights, const float *x, uint16_t *kept,
                         const float *grad_out, float *grad_x, float *grad) {
    Network &net = network();
    net.take(weights, false);
#pragma omp parallel for num_threads(threads)
    for (int thread = 0; thread < threads; thread++) {
        Products products;
        auto sums = std::make_unique<Gradients>();
        for (int64_t b = blocks(count) * thread / threads; b < blocks(count) * (thread + 1) / threads; b++) {
            const int64_t i = b * ROWS;
            Block(kept + i * KEPT).backward(net, count - i < ROWS ? count - i : ROWS, x + i * INPUTS, grad_out + i * OUTPUTS,
                                            grad_x + i * INPUTS, *sums);
        }
        sums->give(grad + thread * WEIGHTS);
    }
}
