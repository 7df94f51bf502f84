// FFTs and banded sums on panels, in plain C++ with GCC's vectors. A panel holds one line of complex samples for as many
// lines as a vector has lanes: [sample][re, im][lane]. No operation crosses lanes, so that any length runs at full width.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <utility>

#include "../../_vector.h"

namespace neusee {

template <class T>
struct Complex {
    Vector<T> re, im;
};

// One axis of the transform, as in _fused_plan.py: interpolate ``n_in`` samples to ``points``, which begin at ``padded``
// in an FFT of ``length``, keep ``kept`` frequencies from ``cropped``, and interpolate those to ``n_out`` samples.
struct Axis {
    int64_t n_in, n_out, points, length, padded, cropped, kept, gather_width, spread_width, passes;
    const int64_t* factors;
    const int32_t *gather_first, *spread_first;
    const void *gather, *spread, *turns;  // (points, gather_width), (n_out, spread_width), (length, re and im)
};

// The sum of ``weights`` times the samples from ``from`` to ``to`` of a panel.
template <class T>
inline Complex<T> weighted(const Complex<T>* panel, const T* weights, int64_t from, int64_t to) {
    Complex<T> even{}, odd{};
    int64_t j = from;
    for (; j + 1 < to; j += 2) {
        even.re += panel[j].re * weights[j];
        even.im += panel[j].im * weights[j];
        odd.re += panel[j + 1].re * weights[j + 1];
        odd.im += panel[j + 1].im * weights[j + 1];
    }
    if (j < to) {
        even.re += panel[j].re * weights[j];
        even.im += panel[j].im * weights[j];
    }
    return {even.re + odd.re, even.im + odd.im};
}

// a * (re + i im) for numbers that all lanes share.
template <class T>
inline Complex<T> times(const Complex<T>& a, T re, T im) {
    return {a.re * re - a.im * im, a.re * im + a.im * re};
}

template <class T>
inline Complex<T> operator+(const Complex<T>& a, const Complex<T>& b) {
    return {a.re + b.re, a.im + b.im};
}
template <class T>
inline Complex<T> operator-(const Complex<T>& a, const Complex<T>& b) {
    return {a.re - b.re, a.im - b.im};
}
template <class T>
inline Complex<T> operator*(const Complex<T>& a, T b) {
    return {a.re * b, a.im * b};
}
template <class T>
inline Complex<T> minus_i(const Complex<T>& a) {
    return {a.im, -a.re};
}

// Discrete Fourier transforms of 2, 3, 4, 5 and 8 samples in place, with exp(-2 pi i j k / R).
template <int R>
struct Short;
template <>
struct Short<2> {
    template <class T>
    static void run(Complex<T>* a) {
        const Complex<T> b = a[0] - a[1];
        a[0] = a[0] + a[1];
        a[1] = b;
    }
};
template <>
struct Short<3> {
    template <class T>
    static void run(Complex<T>* a) {
        const Complex<T> sum = a[1] + a[2], side = minus_i(a[1] - a[2]) * T(0.86602540378443864676);
        const Complex<T> mean = a[0] - sum * T(0.5);
        a[0] = a[0] + sum;
        a[1] = mean + side;
        a[2] = mean - side;
    }
};
template <>
struct Short<4> {
    template <class T>
    static void run(Complex<T>* a) {
        const Complex<T> p = a[0] + a[2], q = a[0] - a[2], r = a[1] + a[3], s = minus_i(a[1] - a[3]);
        a[0] = p + r;
        a[1] = q + s;
        a[2] = p - r;
        a[3] = q - s;
    }
};
template <>
struct Short<5> {
    template <class T>
    static void run(Complex<T>* a) {
        const T c1 = T(0.30901699437494742410), c2 = T(-0.80901699437494742410);
        const T s1 = T(0.95105651629515357212), s2 = T(0.58778525229247312917);
        const Complex<T> p = a[1] + a[4], q = a[2] + a[3], r = minus_i(a[1] - a[4]), s = minus_i(a[2] - a[3]);
        const Complex<T> m1 = a[0] + p * c1 + q * c2, m2 = a[0] + p * c2 + q * c1;
        const Complex<T> n1 = r * s1 + s * s2, n2 = r * s2 - s * s1;
        a[0] = a[0] + p + q;
        a[1] = m1 + n1;
        a[2] = m2 + n2;
        a[3] = m2 - n2;
        a[4] = m1 - n1;
    }
};
template <>
struct Short<8> {
    template <class T>
    static void run(Complex<T>* a) {
        const T half = T(0.70710678118654752440);
        Complex<T> even[4] = {a[0], a[2], a[4], a[6]}, odd[4] = {a[1], a[3], a[5], a[7]};
        Short<4>::run(even);
        Short<4>::run(odd);
        odd[1] = times(odd[1], half, -half);
        odd[2] = minus_i(odd[2]);
        odd[3] = times(odd[3], -half, -half);
        for (int k = 0; k < 4; ++k) {
            a[k] = even[k] + odd[k];
            a[k + 4] = even[k] - odd[k];
        }
    }
};

// One pass of Stockham's FFT over ``length`` samples, after passes whose factors have the product ``done``.
template <int R, class T, class Load, class Store>
void pass(int64_t length, int64_t done, const T* turns, Load load, Store store) {
    const int64_t m = length / (done * R);
    for (int64_t p = 0; p < m; ++p) {
        T re[R], im[R];
        for (int j = 1; j < R; ++j) {
            re[j] = turns[2 * done * p * j];
            im[j] = turns[2 * done * p * j + 1];
        }
        for (int64_t q = 0; q < done; ++q) {
            Complex<T> a[R];
            for (int j = 0; j < R; ++j) a[j] = load(q + done * (p + m * j));
            Short<R>::run(a);
            store(q + done * R * p, a[0]);
            for (int j = 1; j < R; ++j)
                store(q + done * (R * p + j), p ? times(a[j], re[j], im[j]) : a[j]);
        }
    }
}

template <class T, class Load, class Store>
void pass_by(int64_t factor, int64_t length, int64_t done, const T* turns, Load load, Store store) {
    switch (factor) {
        case 2: return pass<2, T>(length, done, turns, load, store);
        case 3: return pass<3, T>(length, done, turns, load, store);
        case 4: return pass<4, T>(length, done, turns, load, store);
        case 5: return pass<5, T>(length, done, turns, load, store);
        default: return pass<8, T>(length, done, turns, load, store);
    }
}

// Write the kept frequencies of the zero-padded panel ``in`` of points to ``out``; ``ping`` and ``pong`` are of ``length``.
template <class T>
void fft(const Axis& axis, const Complex<T>* in, Complex<T>* ping, Complex<T>* pong, Complex<T>* out) {
    const T* turns = static_cast<const T*>(axis.turns);
    const uint64_t points = axis.points, kept = axis.kept;
    const int64_t padded = axis.padded, cropped = axis.cropped;
    auto given = [=](int64_t i) { return uint64_t(i - padded) < points ? in[i - padded] : Complex<T>{}; };
    auto write = [=](int64_t i, const Complex<T>& a) {
        if (uint64_t(i - cropped) < kept) out[i - cropped] = a;
    };
    int64_t done = 1;
    for (int64_t n = 0; n < axis.passes; done *= axis.factors[n++]) {
        const int64_t factor = axis.factors[n];
        Complex<T>*from = ping, *to = pong;
        auto load = [=](int64_t i) { return from[i]; };
        auto store = [=](int64_t i, const Complex<T>& a) { to[i] = a; };
        if (n == 0)
            pass_by<T>(factor, axis.length, done, turns, given, store);
        else if (n == axis.passes - 1)
            pass_by<T>(factor, axis.length, done, turns, load, write);
        else
            pass_by<T>(factor, axis.length, done, turns, load, store);
        std::swap(ping, pong);
    }
}

// A vector of chosen lanes of x and y, of which y's are counted after x's.
template <class V, int... lane>
inline V chosen(const V& x, const V& y, std::integer_sequence<int, lane...>) {
#if defined(__clang__) || __GNUC__ >= 12
    return __builtin_shufflevector(x, y, lane...);
#else
    typedef decltype(x == y) Index;
    return __builtin_shuffle(x, y, Index{lane...});
#endif
}

// The lanes that one row and its partner exchange: those whose number contains ``half``.
template <int half, int... lane>
constexpr auto lower(std::integer_sequence<int, lane...>) {
    constexpr int n = sizeof...(lane);
    return std::integer_sequence<int, (lane & half ? n + lane - half : lane)...>();
}
template <int half, int... lane>
constexpr auto upper(std::integer_sequence<int, lane...>) {
    constexpr int n = sizeof...(lane);
    return std::integer_sequence<int, (lane & half ? n + lane : lane + half)...>();
}

// Exchange the off-diagonal blocks of ``half`` rows and columns within each square of twice that side.
template <class T, int half>
inline void exchange(Vector<T>* a) {
    constexpr auto lanes = std::make_integer_sequence<int, LANES<T>>();
#pragma GCC unroll 16
    for (int r = 0; r < LANES<T>; ++r)
        if (!(r & half)) {
            const Vector<T> x = a[r], y = a[r | half];
            a[r] = chosen(x, y, lower<half>(lanes));
            a[r | half] = chosen(x, y, upper<half>(lanes));
        }
}

// Transpose a square of vectors, row r with column r, in place.
template <class T>
inline void transpose(Vector<T>* a) {
    exchange<T, 1>(a);
    if constexpr (LANES<T> > 2) exchange<T, 2>(a);
    if constexpr (LANES<T> > 4) exchange<T, 4>(a);
    if constexpr (LANES<T> > 8) exchange<T, 8>(a);
}

}  // namespace neusee
