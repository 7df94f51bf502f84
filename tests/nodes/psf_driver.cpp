// Calls the transform of the PSF on arrays in a file: `driver IN OUT`. A file has arrays, each behind its number of bytes.

#include "_fused.cpp"

#include <cstdio>
#include <vector>

namespace {

struct Arrays {
    std::FILE* file;
    std::vector<std::vector<char>> memory;
    template <class E>
    E* next() {
        int64_t bytes = 0;
        if (std::fread(&bytes, sizeof bytes, 1, file) != 1) std::abort();
        memory.emplace_back(bytes);
        if (int64_t(std::fread(memory.back().data(), 1, bytes, file)) != bytes) std::abort();
        return reinterpret_cast<E*>(memory.back().data());
    }
};

Axis axis_of(Arrays& in) {
    const int64_t* n = in.next<int64_t>();
    Axis axis{n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8], n[9]};
    axis.factors = in.next<int64_t>();
    axis.gather_first = in.next<int32_t>();
    axis.spread_first = in.next<int32_t>();
    axis.gather = in.next<void>();
    axis.spread = in.next<void>();
    axis.turns = in.next<void>();
    return axis;
}

template <class T, class A>
void run(Arrays& in, std::FILE* out) {
    const Axis y = axis_of(in), x = axis_of(in);
    Pupil pupil{1};  // factors in double
    pupil.amplitude = in.next<void>();
    pupil.height = in.next<void>();
    pupil.path = in.next<void>();
    const double* scalars = in.next<double>();
    pupil.turns_height = scalars[0];
    pupil.turns_path = scalars[1];
    pupil.tilt_v = in.next<double>();
    pupil.tilt_u = in.next<double>();
    Buffer<T> image(y.n_out * x.n_out);
    Focal<T> focal{scalars[2]};
    focal.envelope_y = in.next<T>();
    focal.envelope_x = in.next<T>();
    focal.intensity = image.get();
    auto tiles = [&](int64_t n) { return (y.kept + LANES<A>) * (n + LANES<T>); };
    Buffer<Complex<A>> before(tiles(x.n_in)), behind(tiles(x.n_out));
    transform<T, A>(y, x, 1, before.get(), behind.get(), PupilSource<T>{pupil, y.n_in, x.n_in},
                    FocalSink<T>{focal, y.n_out, x.n_out});
    std::fwrite(image.get(), sizeof(T), y.n_out * x.n_out, out);
}

}  // namespace

int main(int, char** names) {
    Arrays in{std::fopen(names[1], "rb"), {}};
    std::FILE* out = std::fopen(names[2], "wb");
    if (!in.file || !out) return 1;
    const int64_t pair = *in.next<int64_t>();
    if (pair == 0) run<float, float>(in, out);
    if (pair == 1) run<float, double>(in, out);
    if (pair == 2) run<double, double>(in, out);
    return std::fclose(out);
}
