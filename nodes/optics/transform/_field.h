// What the fused transform reads and writes: the field in the pupil from its factors, the window of the focal plane, and
// the gradients of both. T is the type of the field and of the result.

#pragma once

#ifdef __SSE2__
#include <immintrin.h>
#endif

#include "_fft.h"

namespace neusee {

// Read ``count`` numbers; the rest of the vector is zero.
template <class T>
inline Vector<T> load(const T* from, int64_t count) {
    Vector<T> v{};
    if (count >= LANES<T>)
        std::memcpy(&v, from, sizeof v);
    else if (count > 0)
        std::memcpy(&v, from, sizeof(T) * count);
    return v;
}

template <class T>
inline void store(T* to, const Vector<T>& v, int64_t count) {
    if (count >= LANES<T>)
        std::memcpy(to, &v, sizeof v);
    else if (count > 0)
        std::memcpy(to, &v, sizeof(T) * count);
}

// A plane of numbers (row, column) of ``item`` bytes each, or a null pointer.
struct Plane {
    const void* first;
    int64_t item, height, width;
};

constexpr int64_t AHEAD = 16;  // rows, from the row in use to the row that is fetched

// Fetch a row that will be needed soon. The rows of a large plane lie on different pages, across which no processor
// reads ahead by itself, so that each row would wait for the memory. Always inline, because GCC removes a call of a
// function that only fetches.
template <bool written = false>
[[gnu::always_inline]] inline void fetch_ahead(const Plane& plane, int64_t row, int64_t column) {
    if (!plane.first || row + AHEAD >= plane.height) return;
    const char* at = static_cast<const char*>(plane.first) + ((row + AHEAD) * plane.width + column) * plane.item;
    __builtin_prefetch(at, written);
}

typedef Vector<double> Turns;
constexpr int TURNS = LANES<double>;
typedef float Half __attribute__((vector_size(VECTOR_BYTES / 2)));  // as many floats as a vector has doubles

// Read up to a vector of numbers in double, of an array of floats or doubles.
inline Turns load_turns(const void* from, bool wide, int64_t at, int64_t count) {
    if (wide) return load<double>(static_cast<const double*>(from) + at, count);
    Half v{};
    if (count >= TURNS)
        std::memcpy(&v, static_cast<const float*>(from) + at, sizeof v);
    else if (count > 0)
        std::memcpy(&v, static_cast<const float*>(from) + at, sizeof(float) * count);
    return __builtin_convertvector(v, Turns);
}

// Numbers of the pupil (v, u), in float or, where ``wide``, in double. Phase in turns: height * turns_height +
// path * turns_path + tilt_v + tilt_u, summed in double; no path is a null pointer.
struct Pupil {
    int64_t wide;
    const void *amplitude, *height, *path;
    double turns_height, turns_path;
    const double *tilt_v, *tilt_u;
    [[gnu::always_inline]] void fetch_ahead(int64_t rows, int64_t columns, int64_t v, int64_t u) const {
        for (const void* factor : {amplitude, height, path})
            neusee::fetch_ahead(Plane{factor, wide ? 8 : 4, rows, columns}, v, u);
    }
};

// A vector of T as vectors of doubles, and back.
template <class T>
struct Doubles {
    Turns part[LANES<T> / TURNS];
};
template <int... lane>
inline Vector<float> joined(const Half& low, const Half& high, std::integer_sequence<int, lane...>) {
#if defined(__clang__) || __GNUC__ >= 12
    return __builtin_shufflevector(low, high, lane...);
#else
    return Vector<float>{(lane < TURNS ? low[lane % TURNS] : high[lane % TURNS])...};
#endif
}
inline Vector<double> narrow(const Doubles<double>& v) { return v.part[0]; }
inline Vector<float> narrow(const Doubles<float>& v) {
    const Half low = __builtin_convertvector(v.part[0], Half), high = __builtin_convertvector(v.part[1], Half);
    return joined(low, high, std::make_integer_sequence<int, 2 * TURNS>());
}

template <class T>
inline Doubles<T> read(const void* from, bool wide, int64_t at, int64_t count) {
    Doubles<T> v;
    for (int i = 0; i < LANES<T> / TURNS; ++i)
        v.part[i] = load_turns(from, wide, at + TURNS * i, count - TURNS * i);
    return v;
}

template <class T>
inline Vector<T> read_narrow(const void* from, bool wide, int64_t at, int64_t count) {
    if (sizeof(T) == 4 && !wide) return load<T>(static_cast<const T*>(from) + at, count);
    return narrow(read<T>(from, wide, at, count));
}

template <class T>
inline bool any(const Vector<T>& v) {
    auto set = v != T(0);  // NaN is not zero
#if defined(__AVX512F__)
    __m512i bits;
    std::memcpy(&bits, &set, sizeof bits);
    return _mm512_test_epi32_mask(bits, bits);
#else
    uint64_t word[VECTOR_BYTES / 8], all = 0;
    std::memcpy(word, &set, sizeof word);
    for (uint64_t w : word) all |= w;
    return all;
#endif
}

// How the phasor of type T is computed: the terms of its series, and the number whose addition rounds to whole numbers.
template <class T>
struct Kind;
template <>
struct Kind<float> {
    typedef uint32_t Bits __attribute__((vector_size(VECTOR_BYTES)));
    static constexpr int terms = 5;
    static constexpr float round = 12582912.0f;
};
template <>
struct Kind<double> {
    typedef uint64_t Bits __attribute__((vector_size(VECTOR_BYTES)));
    static constexpr int terms = 9;
    static constexpr double round = 6755399441055744.0;
};

// 1 / n! for the terms of the sine and the cosine.
template <class T>
struct Factorials {
    T below[2 * Kind<T>::terms + 2] = {1};
    constexpr Factorials() {
        for (int i = 1; i < 2 * Kind<T>::terms + 2; ++i) below[i] = below[i - 1] / i;
    }
};

// exp(2 pi i t) for t between -1/2 and 1/2 turn, by Taylor's series within an eighth of a turn.
template <class T>
inline Complex<T> phasor(Vector<T> t) {
    using K = Kind<T>;
    using V = Vector<T>;
    const V shifted = t * T(4) + K::round;
    const V angle = (t - (shifted - K::round) * T(0.25)) * T(6.283185307179586477), square = angle * angle;
    constexpr auto factor = Factorials<T>();
    V sine{}, cosine{};
#pragma GCC unroll 10
    for (int i = K::terms; i >= 0; --i) {
        sine = factor.below[2 * i + 1] - square * sine;
        cosine = factor.below[2 * i] - square * cosine;
    }
    sine *= angle;
    const typename K::Bits quarter = (typename K::Bits)shifted;
    const auto swapped = (quarter & 1) != 0;
    const int top = 8 * sizeof(T) - 2;
    const V re = swapped ? sine : cosine, im = swapped ? cosine : sine;
    return {(V)((typename K::Bits)re ^ (((quarter + 1) & 2) << top)), (V)((typename K::Bits)im ^ ((quarter & 2) << top))};
}

template <class T>
inline Complex<T> phasor_at(const Pupil& pupil, int64_t width, int64_t v, int64_t u, int64_t count) {
    const int64_t at = v * width + u;
    Doubles<T> turns = read<T>(pupil.height, pupil.wide, at, count);
    const Doubles<T> tilt = read<T>(pupil.tilt_u, true, u, count);
    Doubles<T> path{};
    if (pupil.path) path = read<T>(pupil.path, pupil.wide, at, count);
    for (int i = 0; i < LANES<T> / TURNS; ++i) {
        Turns t = turns.part[i] * pupil.turns_height + tilt.part[i];
        if (pupil.path) t += path.part[i] * pupil.turns_path;
        t += pupil.tilt_v[v];
        turns.part[i] = t - ((t + Kind<double>::round) - Kind<double>::round);
    }
    return phasor<T>(narrow(turns));
}

struct Rows {
    int64_t from, to;
};

// The field in the pupil: amplitude times phasor. Rows of a block without light are not computed.
template <class T>
struct PupilSource {
    const Pupil& pupil;
    int64_t height, width;
    Rows operator()(int64_t u, int64_t count, Complex<T>* panel) const {
        Rows lit{height, 0};
        for (int64_t v = 0; v < height; ++v) {
            pupil.fetch_ahead(height, width, v, u);
            const Vector<T> amplitude = read_narrow<T>(pupil.amplitude, pupil.wide, v * width + u, count);
            if (!any<T>(amplitude)) {
                panel[v] = Complex<T>{};
                continue;
            }
            const Complex<T> unit = phasor_at<T>(pupil, width, v, u, count);
            panel[v] = {unit.re * amplitude, unit.im * amplitude};
            lit = {std::min(lit.from, v), v + 1};
        }
        return lit;
    }
};

// A window of the focal plane: weight * envelope_y * envelope_x * |U|^2, and U for the gradient, as planes.
template <class T>
struct Focal {
    double weight;
    const T *envelope_y, *envelope_x;
    T *intensity, *field;
    int64_t add;
};

template <class T>
struct FocalSink {
    const Focal<T>& focal;
    int64_t height, width;
    Rows rows(int64_t, int64_t) const { return {0, height}; }
    void operator()(int64_t y, int64_t x, int64_t count, const Complex<T>& u) const {
        const int64_t at = y * width + x;
        if (focal.field) {
            fetch_ahead<true>({focal.field, sizeof(T), height, width}, y, x);
            fetch_ahead<true>({focal.field + height * width, sizeof(T), height, width}, y, x);
            store<T>(focal.field + at, u.re, count);
            store<T>(focal.field + height * width + at, u.im, count);
        }
        if (!focal.intensity) return;
        fetch_ahead<true>({focal.intensity, sizeof(T), height, width}, y, x);
        Vector<T> power = (u.re * u.re + u.im * u.im) * T(focal.weight);
        if (focal.envelope_y) power *= load<T>(focal.envelope_x + x, count) * focal.envelope_y[y];
        if (focal.add) power += load<T>(focal.intensity + at, count);
        store<T>(focal.intensity + at, power, count);
    }
};

// The adjoint of the transform has the kernel exp(+i ...): re and im change places before it and behind it.
template <class T>
struct FocalSource {
    const Focal<T>& focal;
    const T* gain;
    int64_t height, width;
    Rows operator()(int64_t x, int64_t count, Complex<T>* panel) const {
        const Vector<T> along = focal.envelope_y ? load<T>(focal.envelope_x + x, count) : Vector<T>{} + T(1);
        for (int64_t y = 0; y < height; ++y) {
            const int64_t at = y * width + x;
            fetch_ahead({gain, sizeof(T), height, width}, y, x);
            fetch_ahead({focal.field, sizeof(T), height, width}, y, x);
            fetch_ahead({focal.field + height * width, sizeof(T), height, width}, y, x);
            const T each = T(2 * focal.weight) * (focal.envelope_y ? focal.envelope_y[y] : T(1));
            const Vector<T> weight = load<T>(gain + at, count) * along * each;
            panel[y] = {load<T>(focal.field + height * width + at, count) * weight,
                        load<T>(focal.field + at, count) * weight};
        }
        return {0, height};
    }
};

// Gradients of amplitude, height and path, each added to, or null.
struct Gradients {
    void *amplitude, *height, *path;
};

template <class T>
inline void add_to(void* grad, bool wide, int64_t at, int64_t count, const Vector<T>& more) {
    if (wide == (sizeof(T) == sizeof(double))) {
        T* to = static_cast<T*>(grad) + at;
        return store<T>(to, load<T>(to, count) + more, count);
    }
    T part[LANES<T>];
    std::memcpy(part, &more, sizeof more);
    for (int64_t i = 0; i < std::min<int64_t>(count, LANES<T>); ++i) static_cast<double*>(grad)[at + i] += part[i];
}

template <class T>
struct PupilSink {
    const Pupil& pupil;
    const Gradients& grads;
    int64_t height, width;
    Rows rows(int64_t u, int64_t count) const {
        Rows lit{0, height};
        if (grads.amplitude) return lit;
        auto dark = [=](int64_t v) { return !any<T>(read_narrow<T>(pupil.amplitude, pupil.wide, v * width + u, count)); };
        while (lit.from < height && dark(lit.from)) ++lit.from;
        while (lit.to > lit.from && dark(lit.to - 1)) --lit.to;
        return lit;
    }
    void operator()(int64_t v, int64_t u, int64_t count, const Complex<T>& swapped) const {
        const int64_t at = v * width + u, item = pupil.wide ? 8 : 4;
        pupil.fetch_ahead(height, width, v, u);
        for (const void* gradient : {grads.amplitude, grads.height, grads.path})
            fetch_ahead<true>({gradient, item, height, width}, v, u);
        const Vector<T>&re = swapped.im, &im = swapped.re;
        const Complex<T> unit = phasor_at<T>(pupil, width, v, u, count);
        if (grads.amplitude) add_to<T>(grads.amplitude, pupil.wide, at, count, unit.re * re + unit.im * im);
        if (!grads.height && !grads.path) return;
        const Vector<T> amplitude = read_narrow<T>(pupil.amplitude, pupil.wide, at, count);
        const Vector<T> turning = (unit.re * im - unit.im * re) * amplitude * T(6.283185307179586477);
        if (grads.height) add_to<T>(grads.height, pupil.wide, at, count, turning * T(pupil.turns_height));
        if (grads.path) add_to<T>(grads.path, pupil.wide, at, count, turning * T(pupil.turns_path));
    }
};

}  // namespace neusee
