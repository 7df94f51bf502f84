// The selective scan on a CPU, in plain C++ with GCC's vectors. A vector holds neighbouring channels d, so that any n
// runs at full width and only the gradients of B and C are summed across channels. Layouts as in _selective_scan.py, rows
// contiguous. Decays enter as exp(x) - 1, because the round-off of a decay near 1 would act at each step.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "../../_vector.h"
#ifdef __SSE2__
#include <immintrin.h>
#endif

using namespace neusee;

namespace {

constexpr int64_t STEPS = 32;  // between stored states, so that the states of one chunk fit in the second-level cache

// Channels are summed as if a vector had 64 bytes, of one vector or of several: then a sum has the same order, and so the
// same bits, for every width of a vector.
constexpr int64_t PARTS = 64 / VECTOR_BYTES;
template <class T>
constexpr int64_t CHANNELS = PARTS * LANES<T>;

template <class T>
struct Kind;

template <>
struct Kind<float> {
    typedef int32_t Whole __attribute__((vector_size(VECTOR_BYTES)));
    static constexpr int shift = 23, bias = 127, terms = 7;
    static constexpr float round = 12582912.0f, low = -87.0f, high = 88.0f;
    static constexpr float ln2_high = 0.693359375f, ln2_low = -2.12194440e-4f;
};

template <>
struct Kind<double> {
    typedef int64_t Whole __attribute__((vector_size(VECTOR_BYTES)));
    static constexpr int shift = 52, bias = 1023, terms = 13;
    static constexpr double round = 6755399441055744.0, low = -708.0, high = 709.0;
    static constexpr double ln2_high = 6.93145751953125e-1, ln2_low = 1.42860682030941723212e-6;
};

// While this object lives, subnormal numbers count as zero: a decayed state would stay subnormal, and each product
// with a subnormal number takes a hundred times as long. (The state stays at some 1e-38 / dt |A| instead.)
struct NoSubnormals {
#ifdef __SSE2__
    unsigned before = _mm_getcsr();
    NoSubnormals() { _mm_setcsr(before | 0x8040); }
    ~NoSubnormals() { _mm_setcsr(before); }
#else
    ~NoSubnormals() {}
#endif
};

// exp(x) - 1 and exp(x), each to one or two ulp of its own, by 2^k (1 + p(r)) with |r| <= ln(2)/2.
template <class T>
struct Decay {
    Vector<T> lost, left;
};

template <class T>
inline Decay<T> decay(Vector<T> x) {
    using K = Kind<T>;
    using V = Vector<T>;
    using W = typename K::Whole;
    x = x < K::low ? V{} + K::low : x;
    x = x > K::high ? V{} + K::high : x;
    const V shifted = x * T(1.4426950408889634) + K::round;
    const V k = shifted - K::round;
    V r = x - k * K::ln2_high;
    r = r - k * K::ln2_low;
    T factor[K::terms + 1] = {1, 1};
    for (int i = 2; i <= K::terms; ++i) factor[i] = factor[i - 1] / i;
    V p = V{} + factor[K::terms];
    for (int i = K::terms - 1; i >= 2; --i) p = p * r + factor[i];
    p = p * r * r + r;
    const W power = ((W)shifted - (W)(V{} + K::round) + K::bias) << K::shift;
    const V scale = (V)power;
    return {scale * p + (scale - T(1)), scale * p + scale};
}

template <class T>
inline Vector<T> load(const T* from, int64_t count) {
    Vector<T> v{};
    if (count >= LANES<T>)
        std::memcpy(&v, from, sizeof v);
    else
        std::memcpy(&v, from, sizeof(T) * count);
    return v;
}

template <class T>
inline void store(T* to, const Vector<T>& v, int64_t count) {
    std::memcpy(to, &v, count >= LANES<T> ? sizeof v : sizeof(T) * count);
}

// The sum over the channels of PARTS vectors, which lie ``apart`` from each other.
template <class T>
inline T across(const Vector<T>* v, int64_t apart) {
    T channel[CHANNELS<T>];
    for (int part = 0; part < PARTS; ++part) std::memcpy(channel + part * LANES<T>, v + part * apart, sizeof *v);
    for (int half = CHANNELS<T> / 2; half; half /= 2)
        for (int i = 0; i < half; ++i) channel[i] += channel[i + half];
    return channel[0];
}

// sum += more, with the round-off in ``lost``, which is added at the next step. Otherwise the round-off of thousands of
// steps of a state that hardly decays would exceed the error of the rest of the scan.
template <class V>
inline void add(V& sum, V& lost, V more) {
    more += lost;
    const V now = sum + more;
    lost = more - (now - sum);
    sum = now;
}

struct Sizes {
    int64_t batch, length, d, n, groups, threads;
    int64_t chunks() const { return (length + STEPS - 1) / STEPS; }
};

// The vectors of A for one lane block: (n).
template <class T>
void rates(const Sizes& s, const T* A, int64_t first, Vector<T>* out) {
    for (int64_t n = 0; n < s.n; ++n) {
        out[n] = Vector<T>{};
        for (int64_t i = 0; i < std::min<int64_t>(LANES<T>, s.d - first); ++i)
            out[n][i] = A[(first + i) * s.n + n];
    }
}

template <class T>
void forward_block(const Sizes& s, int64_t b, int64_t first, const T* u, const T* dt, const T* A, const T* B,
                   const T* C, T* y, T* states) {
    using V = Vector<T>;
    std::vector<V> memory(3 * s.n, V{});
    V *h = memory.data(), *rate = h + s.n, *missed = rate + s.n;
    rates<T>(s, A, first, rate);
    const int64_t count = s.d - first;
    for (int64_t t = 0; t < s.length; ++t) {
        const int64_t row = b * s.length + t, at = row * s.d + first;
        if (t % STEPS == 0)
            for (int64_t n = 0; n < s.n; ++n)
                store<T>(states + ((b * s.chunks() + t / STEPS) * s.n + n) * s.d + first, h[n], count);
        const V step = load<T>(dt + at, count), push = step * load<T>(u + at, count);
        V sum{};
        for (int64_t n = 0; n < s.n; ++n) {
            const V lost = decay<T>(step * rate[n]).lost;
            add(h[n], missed[n], lost * h[n] + push * B[row * s.n + n]);
            sum += h[n] * C[row * s.n + n];
        }
        store<T>(y + at, sum, count);
    }
}

template <class T>
struct Gradients {
    T *u, *dt, *A, *B, *C;
};

// One chunk of one lane block backwards. kept: (STEPS + 1, n) states, twice (STEPS, n) decays, (n) for sums;
// acc: (STEPS, n) for the gradient of B and as many for that of C, by lane; carry, its round-off and slope: (n), of the
// state and of A.
template <class T>
void backward_chunk(const Sizes& s, int64_t b, int64_t chunk, int64_t first, const T* u, const T* dt, const T* B,
                    const T* C, const T* dy, const T* states, const Vector<T>* rate, Vector<T>* kept, Vector<T>* acc,
                    Vector<T>* carry, Vector<T>* carried, Vector<T>* slope, const Gradients<T>& out) {
    using V = Vector<T>;
    const int64_t from = chunk * STEPS, steps = std::min(STEPS, s.length - from), count = s.d - first;
    V *h = kept, *lost = kept + (STEPS + 1) * s.n, *left = lost + STEPS * s.n, *missed = left + STEPS * s.n;
    std::fill(missed, missed + s.n, V{});
    const T* state = states + (b * s.chunks() + chunk) * s.n * s.d + first;
    for (int64_t n = 0; n < s.n; ++n) h[n] = load<T>(state + n * s.d, count);
    for (int64_t t = 0; t < steps; ++t) {
        const int64_t row = b * s.length + from + t, at = row * s.d + first;
        const V step = load<T>(dt + at, count), push = step * load<T>(u + at, count);
        for (int64_t n = 0; n < s.n; ++n) {
            const V before = h[t * s.n + n];
            const Decay<T> by = decay<T>(step * rate[n]);
            lost[t * s.n + n] = by.lost;
            left[t * s.n + n] = by.left;
            h[(t + 1) * s.n + n] = before;
            add(h[(t + 1) * s.n + n], missed[n], by.lost * before + push * B[row * s.n + n]);
        }
    }
    for (int64_t t = steps - 1; t >= 0; --t) {
        const int64_t row = b * s.length + from + t, at = row * s.d + first;
        const V step = load<T>(dt + at, count), in = load<T>(u + at, count), push = step * in;
        const V seen = load<T>(dy + at, count);
        V pushed{}, stepped{};
        for (int64_t n = 0; n < s.n; ++n) {
            V g = carry[n];
            add(g, carried[n], seen * C[row * s.n + n]);
            acc[t * s.n + n] += g * push;
            acc[(STEPS + t) * s.n + n] += seen * h[(t + 1) * s.n + n];
            pushed += g * B[row * s.n + n];
            carry[n] = g;
            add(carry[n], carried[n], lost[t * s.n + n] * g);
            const V turned = g * (h[t * s.n + n] * left[t * s.n + n]);
            stepped += turned * rate[n];
            slope[n] += turned * step;
        }
        store<T>(out.u + at, step * pushed, count);
        store<T>(out.dt + at, in * pushed + stepped, count);
    }
}

// The blocks of one group, chunk by chunk from the end, with gradients of B and C summed over the channels of the group.
template <class T>
void backward_group(const Sizes& s, int64_t b, int64_t group, const T* u, const T* dt, const T* A, const T* B,
                    const T* C, const T* dy, const T* states, const Gradients<T>& out) {
    using V = Vector<T>;
    const int64_t lanes = LANES<T>, blocks = (s.d + lanes - 1) / lanes, sums = 2 * STEPS * s.n;
    const int64_t units = (s.d + CHANNELS<T> - 1) / CHANNELS<T>;
    const int64_t begin = units * group / s.groups * PARTS, end = units * (group + 1) / s.groups * PARTS;
    const int64_t own = std::min(end, blocks) - begin;
    std::vector<V> memory((5 * own + 3 * STEPS + 2) * s.n + PARTS * sums, V{});
    V *rate = memory.data(), *carry = rate + own * s.n, *carried = carry + own * s.n;
    V *total = carried + own * s.n, *slope = total + own * s.n;
    V *acc = slope + own * s.n, *kept = acc + PARTS * sums;
    for (int64_t k = 0; k < own; ++k) rates<T>(s, A, (begin + k) * lanes, rate + k * s.n);
    for (int64_t chunk = s.chunks() - 1; chunk >= 0; --chunk) {
        std::fill(slope, kept, V{});
        for (int64_t k = 0; k < own; ++k)
            backward_chunk<T>(s, b, chunk, (begin + k) * lanes, u, dt, B, C, dy, states, rate + k * s.n, kept,
                              acc + k % PARTS * sums, carry + k * s.n, carried + k * s.n, slope + k * s.n, out);
        for (int64_t i = 0; i < own * s.n; ++i) total[i] += slope[i];
        const int64_t steps = std::min(STEPS, s.length - chunk * STEPS);
        const int64_t at = ((group * s.batch + b) * s.length + chunk * STEPS) * s.n;
        for (int64_t i = 0; i < steps * s.n; ++i) {
            out.B[at + i] = across<T>(acc + i, sums);
            out.C[at + i] = across<T>(acc + STEPS * s.n + i, sums);
        }
    }
    for (int64_t k = 0; k < own; ++k)
        for (int64_t n = 0; n < s.n; ++n)
            store<T>(out.A + (b * s.n + n) * s.d + (begin + k) * lanes, total[k * s.n + n], s.d - (begin + k) * lanes);
}

template <class T>
void forward(const Sizes& s, const T* u, const T* dt, const T* A, const T* B, const T* C, T* y, T* states) {
    const int64_t lanes = LANES<T>, blocks = (s.d + lanes - 1) / lanes;
#pragma omp parallel for schedule(static) num_threads(s.threads) if (s.threads > 1)
    for (int64_t unit = 0; unit < s.batch * blocks; ++unit) {
        NoSubnormals quick;
        forward_block<T>(s, unit / blocks, unit % blocks * lanes, u, dt, A, B, C, y, states);
    }
}

template <class T>
void backward(const Sizes& s, const T* u, const T* dt, const T* A, const T* B, const T* C, const T* dy,
              const T* states, const Gradients<T>& out) {
#pragma omp parallel for schedule(static) num_threads(s.threads) if (s.threads > 1)
    for (int64_t unit = 0; unit < s.batch * s.groups; ++unit) {
        NoSubnormals quick;
        backward_group<T>(s, unit / s.groups, unit % s.groups, u, dt, A, B, C, dy, states, out);
    }
}

}  // namespace

// sizes: batch, length, d, n, groups, threads. states: (batch, chunks, n, d). Gradients: A (batch, n, d), B and C
// (group, batch, length, n), which the caller sums over their first dimension.
#define NEUSEE_SCAN(T, name)                                                                                        \
    extern "C" void neusee_scan_forward_##name(const int64_t* sizes, const T* u, const T* dt, const T* A,           \
                                               const T* B, const T* C, T* y, T* states) {                           \
        const Sizes s{sizes[0], sizes[1], sizes[2], sizes[3], sizes[4], sizes[5]};                                  \
        forward<T>(s, u, dt, A, B, C, y, states);                                                                   \
    }                                                                                                               \
    extern "C" void neusee_scan_backward_##name(const int64_t* sizes, const T* u, const T* dt, const T* A,          \
                                                const T* B, const T* C, const T* dy, const T* states, T* du,        \
                                                T* ddt, T* dA, T* dB, T* dC) {                                      \
        const Sizes s{sizes[0], sizes[1], sizes[2], sizes[3], sizes[4], sizes[5]};                                  \
        backward<T>(s, u, dt, A, B, C, dy, states, Gradients<T>{du, ddt, dA, dB, dC});                              \
    }

NEUSEE_SCAN(float, f32)
NEUSEE_SCAN(double, f64)

extern "C" int64_t neusee_scan_steps() { return STEPS; }
extern "C" int64_t neusee_scan_channels(int64_t size) { return PARTS * VECTOR_BYTES / size; }
extern "C" int64_t neusee_scan_vector_bytes() { return VECTOR_BYTES; }
