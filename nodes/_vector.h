// The width of a vector in the C++: as many bytes as a register of the processor that the code is compiled for. GCC splits
// a wider vector into several registers, and moves these to memory and back between any two operations.

#pragma once

#include <cstdint>

namespace neusee {

#if defined(__AVX512F__)
constexpr int VECTOR_BYTES = 64;
#elif defined(__AVX2__)
constexpr int VECTOR_BYTES = 32;
#else
constexpr int VECTOR_BYTES = 16;  // SSE2, NEON, and any other processor
#endif

// Numbers of the type T in one vector.
template <class T>
constexpr int LANES = VECTOR_BYTES / sizeof(T);

template <class T>
struct VectorOf {
    typedef T Type __attribute__((vector_size(VECTOR_BYTES)));
};
template <class T>
using Vector = typename VectorOf<T>::Type;

}  // namespace neusee
