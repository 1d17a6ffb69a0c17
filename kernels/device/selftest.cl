/* Arithmetic that heights rest on, run once when a device is opened and compared with the host bit for bit; ls_gaussian_fill is
   also what benchmarks compare the synthesis with.
   Work size: one work-item per 16 values in x. */
#include "kernels/shared/ls_random.h"

/* out[n] = Gaussian of index (i0 + n, j) of one stream, n < 16 * blocks. */
LS_KERNEL void ls_gaussian_fill(__global float* out, uint i0, uint j, uint stream, uint k0, uint k1, uint blocks) {
  const uint item = get_global_id(0);
  if (item >= blocks) return;
  const uint16 lane = (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  vstore16(ls_gaussian16(i0 + item * 16 + lane, (uint16)(j), stream, k0, k1), item, out);
}

/* a, b: count floats, count a multiple of 16. out: a / b, then sqrt(b), then ls_gaussian(bits of a, bits of b, 1, 2, 3). */
LS_KERNEL void ls_arithmetic(__global const float* a, __global const float* b, __global float* out, uint count) {
  const uint item = get_global_id(0);
  if (item * 16 >= count) return;
  const float16 x = vload16(item, a), y = vload16(item, b);
  vstore16(x / y, item, out);
  vstore16(sqrt(y), item, out + count);
  vstore16(ls_gaussian16(as_uint16(x), as_uint16(y), 1, 2, 3), item, out + 2 * count);
}
