// The PSF of a pupil and its gradient on a CPU, in three sweeps over columns, rows and columns. The first makes the field
// and interpolates and transforms it along y, the second transforms and interpolates it along x, the third interpolates
// it along y and uses it. Between sweeps the field lies in tiles: [block of lanes][sample][re, im][lane].
// T is the type of the field and the result; A, the type from the first FFT on, is double where that costs little.

#include <cstdlib>
#include <memory>
#include <new>

#include "_field.h"

using namespace neusee;

namespace {

struct Freed {
    void operator()(void* p) const { std::free(p); }
};

// A buffer of n elements, aligned to vectors.
template <class E>
struct Buffer {
    std::unique_ptr<E, Freed> held;
    explicit Buffer(int64_t n) : held(static_cast<E*>(std::aligned_alloc(64, (n * sizeof(E) + 63) / 64 * 64))) {
        if (!held) throw std::bad_alloc();
    }
    E* get() const { return held.get(); }
};

inline int64_t blocks(int64_t n, int64_t size) { return (n + size - 1) / size; }

// Vectors of A for each vector of T, and the parts of one.
template <class T, class A>
constexpr int parts() {
    return LANES<T> / LANES<A>;
}

template <class T, class A>
inline Complex<A> part_of(const Complex<T>& x, int part) {
    typedef T Part __attribute__((vector_size(LANES<A> * sizeof(T))));
    Part re, im;
    std::memcpy(&re, reinterpret_cast<const char*>(&x.re) + part * sizeof re, sizeof re);
    std::memcpy(&im, reinterpret_cast<const char*>(&x.im) + part * sizeof im, sizeof im);
    return {__builtin_convertvector(re, Vector<A>), __builtin_convertvector(im, Vector<A>)};
}

template <class T, class A>
inline void set_part(Complex<T>& x, int part, const Complex<A>& from) {
    typedef T Part __attribute__((vector_size(LANES<A> * sizeof(T))));
    const Part re = __builtin_convertvector(from.re, Part), im = __builtin_convertvector(from.im, Part);
    std::memcpy(reinterpret_cast<char*>(&x.re) + part * sizeof re, &re, sizeof re);
    std::memcpy(reinterpret_cast<char*>(&x.im) + part * sizeof im, &im, sizeof im);
}

// Buffers of one thread, for panels of the longest axis.
template <class T, class A>
struct Desk {
    Buffer<Complex<T>> field;
    Buffer<Complex<A>> samples, points, ping, pong;
    Desk(const Axis& y, const Axis& x)
        : field(y.n_in),
          samples(std::max(x.n_in + LANES<A>, x.kept)),
          points(std::max(parts<T, A>() * y.points, x.points)),
          ping(std::max(y.length, x.length)),
          pong(std::max(y.length, x.length)) {}
};

// Sweep 1, for the block of columns from u: field -> points along y -> frequencies.
template <class T, class A, class Source>
void columns_in(const Axis& y, int64_t width, int64_t u, const Source& source, Complex<A>* tiles,
                Desk<T, A>& desk) {
    const int64_t tile = blocks(y.kept, LANES<A>) * LANES<A>;
    const T* weights = static_cast<const T*>(y.gather);
    Complex<T>* field = desk.field.get();
    const Rows lit = source(u, width - u, field);
    for (int64_t l = 0; l < y.points; ++l) {
        const int64_t from = y.gather_first[l];
        const Complex<T> point = weighted<T>(field + from, weights + l * y.gather_width, std::max<int64_t>(0, lit.from - from),
                                             std::min<int64_t>(y.gather_width, lit.to - from));
        for (int i = 0; i < parts<T, A>(); ++i) desk.points.get()[i * y.points + l] = part_of<T, A>(point, i);
    }
    for (int i = 0; i < parts<T, A>(); ++i) {
        Complex<A>* out = tiles + (u / LANES<A> + i) * tile;
        fft<A>(y, desk.points.get() + i * y.points, desk.ping.get(), desk.pong.get(), out);
        std::fill(out + y.kept, out + tile, Complex<A>{});
    }
}

template <class A>
inline void transpose_both(Complex<A>* a) {
    constexpr int n = LANES<A>;
    Vector<A> re[n], im[n];
#pragma GCC unroll 16
    for (int i = 0; i < n; ++i) re[i] = a[i].re, im[i] = a[i].im;
    transpose<A>(re);
    transpose<A>(im);
#pragma GCC unroll 16
    for (int i = 0; i < n; ++i) a[i] = {re[i], im[i]};
}

// Fetch a square of a tile that will be needed soon: the squares of neighbouring tiles lie on different pages.
template <class A>
[[gnu::always_inline]] inline void fetch_square(const Complex<A>* square) {
    const char* first = reinterpret_cast<const char*>(square);
    for (size_t byte = 0; byte < LANES<A> * sizeof *square; byte += 64) __builtin_prefetch(first + byte);
}

// Sweep 2, for the block of frequencies along y from k: samples along x -> points -> frequencies -> samples.
template <class T, class A>
void rows_through(const Axis& y, const Axis& x, int64_t k, const Complex<A>* in, Complex<A>* out, Desk<T, A>& desk) {
    constexpr int n = LANES<A>;
    const int64_t tile = blocks(y.kept, n) * n;
    Complex<A> *samples = desk.samples.get(), *points = desk.points.get(), square[n];
    for (int64_t u = 0; u < x.n_in; u += n) {
        if (u + 2 * n < x.n_in) fetch_square(in + (u / n + 2) * tile + k);
        std::memcpy(samples + u, in + u / n * tile + k, n * sizeof *samples);
        transpose_both<A>(samples + u);
    }
    const A *gather = static_cast<const A*>(x.gather), *spread = static_cast<const A*>(x.spread);
    for (int64_t l = 0; l < x.points; ++l)
        points[l] = weighted<A>(samples + x.gather_first[l], gather + l * x.gather_width, 0, x.gather_width);
    fft<A>(x, points, desk.ping.get(), desk.pong.get(), samples);
    for (int64_t i = 0; i < x.n_out; i += n) {
        for (int64_t j = 0; j < n; ++j)
            square[j] = i + j >= x.n_out ? Complex<A>{}
                                         : weighted<A>(samples + x.spread_first[i + j], spread + (i + j) * x.spread_width,
                                                       0, x.spread_width);
        transpose_both<A>(square);
        std::memcpy(out + i / n * tile + k, square, sizeof square);
    }
}

// Sweep 3, for the block of columns from x: frequencies -> samples along y.
template <class T, class A, class Sink>
void columns_out(const Axis& y, int64_t width, int64_t x, const Complex<A>* tiles, const Sink& sink) {
    const int64_t tile = blocks(y.kept, LANES<A>) * LANES<A>;
    const int64_t there = std::min<int64_t>(parts<T, A>(), blocks(width - x, LANES<A>));
    const A* spread = static_cast<const A*>(y.spread);
    const Rows wanted = sink.rows(x, width - x);
    for (int64_t i = wanted.from; i < wanted.to; ++i) {
        const Complex<A>* in = tiles + x / LANES<A> * tile + y.spread_first[i];
        Complex<T> sample{};
        for (int64_t part = 0; part < there; ++part)
            set_part<T, A>(sample, part, weighted<A>(in + part * tile, spread + i * y.spread_width, 0, y.spread_width));
        sink(i, x, width - x, sample);
    }
}

template <class T, class A, class Source, class Sink>
void transform(const Axis& y, const Axis& x, int64_t threads, void* before, void* behind, const Source& source,
               const Sink& sink) {
    Complex<A>*in = static_cast<Complex<A>*>(before), *out = static_cast<Complex<A>*>(behind);
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        Desk<T, A> desk(y, x);
#pragma omp for schedule(dynamic)
        for (int64_t u = 0; u < x.n_in; u += LANES<T>) columns_in<T, A>(y, x.n_in, u, source, in, desk);
#pragma omp for schedule(dynamic)
        for (int64_t k = 0; k < y.kept; k += LANES<A>) rows_through<T, A>(y, x, k, in, out, desk);
#pragma omp for schedule(dynamic)
        for (int64_t u = 0; u < x.n_out; u += LANES<T>) columns_out<T, A>(y, x.n_out, u, out, sink);
    }
}

}  // namespace

#define NEUSEE_PSF(T, A, name)                                                                                       \
    extern "C" void neusee_psf_forward_##name(const Axis* y, const Axis* x, int64_t threads, void* before,           \
                                              void* behind, const Pupil* pupil, const Focal<T>* focal) {             \
        transform<T, A>(*y, *x, threads, before, behind, PupilSource<T>{*pupil, y->n_in, x->n_in},                   \
                        FocalSink<T>{*focal, y->n_out, x->n_out});                                                   \
    }                                                                                                                \
    extern "C" void neusee_psf_adjoint_##name(const Axis* y, const Axis* x, int64_t threads, void* before,           \
                                              void* behind, const Focal<T>* focal, const T* gain,                    \
                                              const Pupil* pupil, const Gradients* grads) {                          \
        transform<T, A>(*y, *x, threads, before, behind, FocalSource<T>{*focal, gain, y->n_in, x->n_in},             \
                        PupilSink<T>{*pupil, *grads, y->n_out, x->n_out});                                           \
    }

NEUSEE_PSF(float, float, single)
NEUSEE_PSF(float, double, mixed)
NEUSEE_PSF(double, double, double)

extern "C" int64_t neusee_psf_vector_bytes() { return VECTOR_BYTES; }
