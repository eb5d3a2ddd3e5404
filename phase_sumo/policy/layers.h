// The layers of the scene encoder, and sums of their gradients.

#pragma once

#ifdef BF16
#include "products_bf16.h"
#else
#include "products_fp32.h"
#endif

constexpr int SIZE = WIDTH / HEADS;                       // of a head
constexpr int KEY = 0, VALUE = WIDTH, SCORE = 2 * WIDTH;  // rows of what a road point gives
constexpr int GIVEN = 2 * WIDTH + SEEDS;

template <int O, int I>
struct Linear {
    Matrix<O, I> matrix;
    alignas(64) float bias[whole(O) * VECTOR] = {};

    const float *take(const float *weights) {  // returns what follows
        matrix.prepare(weights);
        weights += O * I;
        for (int o = 0; o < O; o++) store(bias + o * VECTOR, Vector{} + weights[o]);
        return weights + O;
    }

    template <int L>
    void forward(const float *x, float *y) const {  // y has room for whole(O) rows
        matrix.template times<L>(x, y, bias);
    }

    template <int L, Start START = FROM_ZERO>
    void backward_input(const float *grad_y, float *grad_x) const {
        matrix.template turned_times<START, L>(grad_y, grad_x);
    }
};

template <int O, int I>
struct Gradient {
    alignas(64) float matrix[whole(O) * whole(I)] = {}, bias[O] = {};

    template <int L>
    void add(const float *x, const float *grad_y) {
        multiply_turned<FROM_C, O, L, I>(grad_y, x, matrix);
        for (int o = 0; o < O; o++) {
            Vector total = {};
            for (int l = 0; l < L; l += VECTOR) total += load(grad_y + o * L + l);
            bias[o] += sum(total);
        }
    }

    float *give(float *grad) const {  // returns what follows
        for (int o = 0; o < O; o++) std::memcpy(grad + o * I, matrix + o * whole(I), sizeof(float) * I);
        std::memcpy(grad + O * I, bias, sizeof(bias));
        return grad + O * I + O;
    }
};

// Linear or Gradient for every layer, in the order of their weights
template <template <int, int> class Of>
struct Layers {
    Of<HIDDEN, PARTNER_FEATURES> partner_in;
    Of<WIDTH, HIDDEN> partner_out;
    Of<HIDDEN, ROAD_FEATURES> road_in;
    Of<GIVEN, HIDDEN> road_out;
    Of<WIDTH, WIDTH> query, attended;
    Of<FEEDFORWARD, WIDTH> feed_in;
    Of<WIDTH, FEEDFORWARD> feed_out;
    Of<SEEDS, WIDTH> score;

    template <class Visit>
    void each(Visit visit) {
        visit(partner_in), visit(partner_out), visit(road_in), visit(road_out), visit(query), visit(attended);
        visit(feed_in), visit(feed_out), visit(score);
    }
};

using Gradients = Layers<Gradient>;

struct Network : Layers<Linear> {
    explicit Network(const float *weights) {
        each([&](auto &layer) { weights = layer.take(weights); });
    }
};

constexpr int count(int o, int i) { return o * i + o; }
constexpr int WEIGHTS = count(HIDDEN, PARTNER_FEATURES) + count(WIDTH, HIDDEN) + count(HIDDEN, ROAD_FEATURES) +
                        count(GIVEN, HIDDEN) + 2 * count(WIDTH, WIDTH) + count(FEEDFORWARD, WIDTH) +
                        count(WIDTH, FEEDFORWARD) + count(SEEDS, WIDTH);

