/* What the shared headers need to mean the same to OpenCL C and to C++. The text is also pasted into kernel source. */
#ifndef LS_PLATFORM_H
#define LS_PLATFORM_H

#if !defined(__OPENCL_VERSION__) && !defined(__OPENCL_C_VERSION__) /* clang's own check defines only the second */
#include <cstdint>
typedef std::uint32_t ls_uint;
typedef std::uint64_t ls_ulong;
#define LS_FN inline
#define LS_PRIVATE
#else
#pragma OPENCL FP_CONTRACT OFF
typedef uint ls_uint;
typedef ulong ls_ulong;
#define LS_FN static inline __attribute__((always_inline))
#define LS_PRIVATE __private
/* Work-items per group, fixed at build time so that no compilation is left for the first launch. */
#ifndef LS_LOCAL_SIZE
#define LS_LOCAL_SIZE 64
#endif
#define LS_KERNEL __kernel __attribute__((reqd_work_group_size(LS_LOCAL_SIZE, 1, 1)))
#endif

#endif
