/* What the shared headers need to mean the same to OpenCL C and to C++. The text is also pasted into kernel source. */
#ifndef LS_PLATFORM_H
#define LS_PLATFORM_H

#if !defined(__OPENCL_VERSION__) && !defined(__OPENCL_C_VERSION__) /* clang's own check defines only the second */
#include <cstdint>
typedef std::uint32_t ls_uint;
typedef std::uint64_t ls_ulong;
#define LS_FN inline
#else
#pragma OPENCL FP_CONTRACT OFF
typedef uint ls_uint;
typedef ulong ls_ulong;
#define LS_FN static inline __attribute__((always_inline))
#endif

#endif
