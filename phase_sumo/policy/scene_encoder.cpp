// SceneEncoder (scene_encoder.py) for a few agents after another, forward and backward.
//
// The partners and road points of some AGENTS are the lanes of vector registers: every feature is a row of
// OTHERS or ROADS numbers, all matrices are small, sizes are known when this is compiled, and nothing
// but features and results leaves the first cache levels. The backward pass works the forward pass out again
// instead of keeping it. Weights come as one array, layer by layer as in the module, a bias after its matrix;
// so do their gradients. Matrix products are those of fp32, or with -DBF16 of bf16; all else is fp32.

#include "layers.h"

namespace {

constexpr int OTHERS = AGENTS * PARTNERS, ROADS = AGENTS * POINTS;
constexpr int PARTNER_STRIDE = PARTNER_FEATURES * PARTNERS, ROAD_STRIDE = ROAD_FEATURES * POINTS,
              POOLED_STRIDE = 2 * SEEDS * WIDTH;

// what agents see: partner [count][features][partners], road [count][features][points], masks one byte an element
struct Seen {
    const float *partner;
    const uint8_t *partner_mask;
    const float *road;
    const uint8_t *road_mask;
};

// rows of scores to weights e^s / (1 + sum e^s) over the L lanes that are live
template <int L, int STRIDE>
inline void pool_weights(float *score, const float *live) {
    for (int s = 0; s < SEEDS; s++) {
        float *row = score + s * STRIDE;
        Vector lanes = {}, sums = {};
        for (int l = 0; l < L; l += VECTOR) lanes = larger(lanes, load(row + l) * load(live + l));
        const Vector most = Vector{} + largest(lanes);
        for (int l = 0; l < L; l += VECTOR) {
            Vector e = exponential(smaller(load(row + l), most) - most) * load(live + l);
            store(row + l, e);
            sums += e;
        }
        const Vector scale = 1.0f / (sum(sums) + exponential(-most));
        for (int l = 0; l < L; l += VECTOR) store(row + l, load(row + l) * scale);
    }
}

// pooled[S][WIDTH] = weight[S][L] values[WIDTH][L]^T
template <int L, int STRIDE>
inline void pool(const float *weight, const float *values, float *pooled) {
    alignas(64) float result[whole(SEEDS) * WIDTH];
    multiply_turned<FROM_ZERO, SEEDS, L, WIDTH, STRIDE, STRIDE>(weight, values, result);
    std::memcpy(pooled, result, sizeof(float) * SEEDS * WIDTH);
}

// gradients of scores and values (added) from that of pooled
template <int L, int STRIDE>
inline void pool_backward(const float *weight, const float *values, const float *grad_pooled, float *grad_score,
                          float *grad_values) {
    multiply<FROM_ZERO, SEEDS, WIDTH, L, WIDTH, 1, STRIDE, STRIDE>(grad_pooled, values, grad_score);
    multiply<FROM_C, WIDTH, SEEDS, L, 1, WIDTH, STRIDE, STRIDE>(grad_pooled, weight, grad_values);
    for (int s = 0; s < SEEDS; s++) {
        const float *w = weight + s * STRIDE;
        float *grad = grad_score + s * STRIDE;
        Vector sums = {};
        for (int l = 0; l < L; l += VECTOR) sums += load(w + l) * load(grad + l);
        const float mean = sum(sums);
        for (int l = 0; l < L; l += VECTOR) store(grad + l, load(w + l) * (load(grad + l) - mean));
    }
}

// rows of L numbers of one agent to rows of all AGENTS
template <int ROWS, int L>
inline void place(const float *from, float *to) {
    for (int row = 0; row < ROWS; row++) std::memcpy(to + row * AGENTS * L, from + row * L, sizeof(float) * L);
}

struct Agents {
    alignas(64) float seen_partner[PARTNER_FEATURES * OTHERS], partner_live[OTHERS];
    alignas(64) float seen_road[ROAD_FEATURES * ROADS], road_live[ROADS];
    alignas(64) float road_normal[HIDDEN * ROADS], road_scale[ROADS];
    alignas(64) float road_hidden[HIDDEN * ROADS];
    alignas(64) float road[whole(GIVEN) * ROADS];  // keys, values, pooling weights
    alignas(64) float partner_normal[HIDDEN * OTHERS], partner_scale[OTHERS];
    alignas(64) float partner_hidden[HIDDEN * OTHERS];
    alignas(64) float partner[WIDTH * OTHERS];
    alignas(64) float query[WIDTH * OTHERS];
    alignas(64) float attention[AGENTS * HEADS * POINTS * PARTNERS];
    alignas(64) float attended[WIDTH * OTHERS];
    alignas(64) float informed[WIDTH * OTHERS];
    alignas(64) float informed_normal[WIDTH * OTHERS], informed_scale[OTHERS];
    alignas(64) float feed[FEEDFORWARD * OTHERS];
    alignas(64) float fused[WIDTH * OTHERS];
    alignas(64) float fused_normal[WIDTH * OTHERS], fused_scale[OTHERS];
    alignas(64) float weight[whole(SEEDS) * OTHERS];

    // the agents from ``first`` on, ``count`` of them; the others see nothing
    void look(const Seen &seen, int64_t first, int count) {
        if (count < AGENTS) {
            clear<PARTNER_FEATURES * OTHERS>(seen_partner), clear<OTHERS>(partner_live);
            clear<ROAD_FEATURES * ROADS>(seen_road), clear<ROADS>(road_live);
        }
        for (int a = 0; a < count; a++) {
            const int64_t i = first + a;
            place<PARTNER_FEATURES, PARTNERS>(seen.partner + i * PARTNER_STRIDE, seen_partner + a * PARTNERS);
            place<ROAD_FEATURES, POINTS>(seen.road + i * ROAD_STRIDE, seen_road + a * POINTS);
            for (int l = 0; l < PARTNERS; l++) partner_live[a * PARTNERS + l] = seen.partner_mask[i * PARTNERS + l];
            for (int l = 0; l < POINTS; l++) road_live[a * POINTS + l] = seen.road_mask[i * POINTS + l];
        }
    }

    void attend() {
        const float scale = 1.0f / __builtin_sqrtf(SIZE);
        for (int a = 0; a < AGENTS; a++)
            for (int h = 0; h < HEADS; h++) {
                float *p = attention + (a * HEADS + h) * POINTS * PARTNERS;
                const float *live = road_live + a * POINTS;
                const float *keys = road + (KEY + h * SIZE) * ROADS + a * POINTS, *values = keys + (VALUE - KEY) * ROADS;
                const int at = h * SIZE * OTHERS + a * PARTNERS;
                multiply<FROM_ZERO, POINTS, SIZE, PARTNERS, 1, ROADS, OTHERS, PARTNERS>(keys, query + at, p);
                for (int l = 0; l < PARTNERS; l += VECTOR) {
                    Vector most = {};
                    for (int r = 0; r < POINTS; r++) most = larger(most, load(p + r * PARTNERS + l) * live[r]);
                    Vector sums = exponential(-most * scale) + total<POINTS>([&](int r) {
                        float *at = p + r * PARTNERS + l;
                        Vector e = exponential((smaller(load(at), most) - most) * scale) * live[r];
                        store(at, e);
                        return e;
                    });
                    sums = 1.0f / sums;
                    for (int r = 0; r < POINTS; r++) store(p + r * PARTNERS + l, load(p + r * PARTNERS + l) * sums);
                }
                multiply<FROM_ZERO, SIZE, POINTS, PARTNERS, ROADS, 1, PARTNERS, OTHERS>(values, p, attended + at);
            }
    }

    void forward(const Network &net) {
        net.road_in.forward<ROADS>(seen_road, road_hidden);
        normalise<HIDDEN, ROADS>(road_hidden, road_normal, road_scale);
        rectify<HIDDEN * ROADS>(road_normal, road_hidden);
        net.road_out.forward<ROADS>(road_hidden, road);
        net.partner_in.forward<OTHERS>(seen_partner, partner_hidden);
        normalise<HIDDEN, OTHERS>(partner_hidden, partner_normal, partner_scale);
        rectify<HIDDEN * OTHERS>(partner_normal, partner_hidden);
        net.partner_out.forward<OTHERS>(partner_hidden, partner);
        net.query.forward<OTHERS>(partner, query);
        attend();
        net.attended.forward<OTHERS>(attended, informed);
        add<WIDTH * OTHERS>(partner, informed);
        normalise<WIDTH, OTHERS>(informed, informed_normal, informed_scale);
        net.feed_in.forward<OTHERS>(informed_normal, feed);
        rectify<FEEDFORWARD * OTHERS>(feed, feed);
        net.feed_out.forward<OTHERS>(feed, fused);
        add<WIDTH * OTHERS>(informed, fused);
        normalise<WIDTH, OTHERS>(fused, fused_normal, fused_scale);
        net.score.forward<OTHERS>(fused_normal, weight);
        for (int a = 0; a < AGENTS; a++) {
            pool_weights<PARTNERS, OTHERS>(weight + a * PARTNERS, partner_live + a * PARTNERS);
            pool_weights<POINTS, ROADS>(road + SCORE * ROADS + a * POINTS, road_live + a * POINTS);
        }
    }

    // pooled [count][2][seeds][width]
    void pool_sets(int count, float *pooled) const {
        for (int a = 0; a < count; a++, pooled += POOLED_STRIDE) {
            const float *points = road + a * POINTS;
            pool<PARTNERS, OTHERS>(weight + a * PARTNERS, fused + a * PARTNERS, pooled);
            pool<POINTS, ROADS>(points + SCORE * ROADS, points + VALUE * ROADS, pooled + SEEDS * WIDTH);
        }
    }

    // gradient of the queries, and of keys and values (added) into grad_road
    void attend_backward(const float *grad_attended, float *grad_query, float *grad_road) const {
        alignas(64) float grad[POINTS * PARTNERS];
        const float scale = 1.0f / __builtin_sqrtf(SIZE);
        for (int a = 0; a < AGENTS; a++)
            for (int h = 0; h < HEADS; h++) {
                const float *p = attention + (a * HEADS + h) * POINTS * PARTNERS;
                const int keys = (KEY + h * SIZE) * ROADS + a * POINTS, values = keys + (VALUE - KEY) * ROADS;
                const int at = h * SIZE * OTHERS + a * PARTNERS;
                const float *grad_out = grad_attended + at;
                multiply_turned<FROM_C, SIZE, PARTNERS, POINTS, OTHERS, PARTNERS, ROADS>(grad_out, p, grad_road + values);
                multiply<FROM_ZERO, POINTS, SIZE, PARTNERS, 1, ROADS, OTHERS, PARTNERS>(road + values, grad_out, grad);
                for (int l = 0; l < PARTNERS; l += VECTOR) {
                    const Vector mean = total<POINTS>(
                        [&](int r) { return load(p + r * PARTNERS + l) * load(grad + r * PARTNERS + l); });
                    for (int r = 0; r < POINTS; r++) {
                        const int to = r * PARTNERS + l;
                        store(grad + to, load(p + to) * (load(grad + to) - mean) * scale);
                    }
                }
                multiply<FROM_ZERO, SIZE, POINTS, PARTNERS, ROADS, 1, PARTNERS, OTHERS>(road + keys, grad, grad_query + at);
                multiply_turned<FROM_C, SIZE, PARTNERS, POINTS, OTHERS, PARTNERS, ROADS>(query + at, grad, grad_road + keys);
            }
    }

    // adds to the sums; gradients of pooled [count][2][seeds][width]
    void backward(const Network &net, int count, const float *grad_pooled, Gradients &sums) const {
        alignas(64) float grad_road[whole(GIVEN) * ROADS] = {}, grad_fused[WIDTH * OTHERS] = {};
        alignas(64) float grad_score[whole(SEEDS) * OTHERS] = {}, grad_query[WIDTH * OTHERS], grad_normal[WIDTH * OTHERS];
        alignas(64) float grad_hidden[HIDDEN * ROADS], grad_feed[FEEDFORWARD * OTHERS], grad_attended[WIDTH * OTHERS];
        for (int a = 0; a < count; a++, grad_pooled += POOLED_STRIDE) {
            const int points = a * POINTS, others = a * PARTNERS;
            pool_backward<POINTS, ROADS>(road + SCORE * ROADS + points, road + VALUE * ROADS + points,
                                         grad_pooled + SEEDS * WIDTH, grad_road + SCORE * ROADS + points,
                                         grad_road + VALUE * ROADS + points);
            pool_backward<PARTNERS, OTHERS>(weight + others, fused + others, grad_pooled, grad_score + others,
                                            grad_fused + others);
        }
        sums.score.add<OTHERS>(fused_normal, grad_score);
        net.score.backward_input<OTHERS>(grad_score, grad_normal);
        normalise_backward<WIDTH, OTHERS, true>(fused_normal, fused_scale, grad_normal, grad_fused);
        sums.feed_out.add<OTHERS>(feed, grad_fused);
        net.feed_out.backward_input<OTHERS>(grad_fused, grad_feed);
        rectify_backward<FEEDFORWARD * OTHERS>(feed, grad_feed);
        sums.feed_in.add<OTHERS>(informed_normal, grad_feed);
        net.feed_in.backward_input<OTHERS>(grad_feed, grad_normal);
        // from here on grad_fused is the gradient of informed
        normalise_backward<WIDTH, OTHERS, true>(informed_normal, informed_scale, grad_normal, grad_fused);
        sums.attended.add<OTHERS>(attended, grad_fused);
        net.attended.backward_input<OTHERS>(grad_fused, grad_attended);
        attend_backward(grad_attended, grad_query, grad_road);
        sums.query.add<OTHERS>(partner, grad_query);
        net.query.backward_input<OTHERS, FROM_C>(grad_query, grad_fused);  // now that of partner
        sums.partner_out.add<OTHERS>(partner_hidden, grad_fused);
        net.partner_out.backward_input<OTHERS>(grad_fused, grad_hidden);
        rectify_backward<HIDDEN * OTHERS>(partner_hidden, grad_hidden);
        normalise_backward<HIDDEN, OTHERS, false>(partner_normal, partner_scale, grad_hidden, grad_hidden);
        sums.partner_in.add<OTHERS>(seen_partner, grad_hidden);
        sums.road_out.add<ROADS>(road_hidden, grad_road);
        net.road_out.backward_input<ROADS>(grad_road, grad_hidden);
        rectify_backward<HIDDEN * ROADS>(road_hidden, grad_hidden);
        normalise_backward<HIDDEN, ROADS, false>(road_normal, road_scale, grad_hidden, grad_hidden);
        sums.road_in.add<ROADS>(seen_road, grad_hidden);
    }
};

}  // namespace

extern "C" bool is_ready() { return ready(); }  // false: this processor cannot do it
extern "C" int weight_count() { return WEIGHTS; }
extern "C" int pooled_count() { return POOLED_STRIDE; }

extern "C" void forward(int64_t count, int threads, const float *weights, const float *partner,
                        const uint8_t *partner_mask, const float *road, const uint8_t *road_mask, float *pooled) {
    const Network net(weights);
    const Seen seen{partner, partner_mask, road, road_mask};
#pragma omp parallel num_threads(threads)
    {
        Products products;
        Agents agents;
#pragma omp for
        for (int64_t i = 0; i < count; i += AGENTS) {
            const int some = count - i < AGENTS ? count - i : AGENTS;
            agents.look(seen, i, some);
            agents.forward(net);
            agents.pool_sets(some, pooled + i * POOLED_STRIDE);
        }
    }
}

// grad [threads][weight_count()]; even parts of the agents, so that a number of threads fixes the result
extern "C" void backward(int64_t count, int threads, const float *weights, const float *partner,
                         const uint8_t *partner_mask, const float *road, const uint8_t *road_mask,
                         const float *grad_pooled, float *grad) {
    const Network net(weights);
    const Seen seen{partner, partner_mask, road, road_mask};
#pragma omp parallel for num_threads(threads)
    for (int thread = 0; thread < threads; thread++) {
        Products products;
        Agents agents;
        Gradients sums;
        const int64_t end = count * (thread + 1) / threads;
        for (int64_t i = count * thread / threads; i < end; i += AGENTS) {
            const int some = end - i < AGENTS ? end - i : AGENTS;
            agents.look(seen, i, some);
            agents.forward(net);
            agents.backward(net, some, grad_pooled + i * POOLED_STRIDE, sums);
        }
        float *to = grad + thread * WEIGHTS;
        sums.each([&](auto &layer) { to = layer.give(to); });
    }
}
