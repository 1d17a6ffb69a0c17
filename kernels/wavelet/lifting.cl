/* Lifting steps of CDF(2,2) and CDF(4,4). Source: SPEC-SYNTHESIS section 2. Twin: lifting.cpp.
   Heights and details are f32 metres. ls_inverse22 is fused and 16 coarse columns wide, because that is what runs near the speed
   of memory; the others favour few lines over speed. */
#include "kernels/shared/ls_wavelet.h"

/* Heights of one fine row of 32 posts (and the one after them) from lo and hx; out_even: fine posts 2i, out_odd: 2i + 1. */
LS_FN void ls_store_row(__global float* out, float16 lo, float16 lo_after, float16 hx_before, float16 hx, float16 hx_after, bool is_last) {
  const float16 even = LS_EVEN22(lo, hx_before, hx), after = LS_EVEN22(lo_after, hx, hx_after);
  const float16 odd = LS_ODD22(hx, even, after);
  vstore16((float16)(even.s0, odd.s0, even.s1, odd.s1, even.s2, odd.s2, even.s3, odd.s3, even.s4, odd.s4, even.s5, odd.s5, even.s6,
                     odd.s6, even.s7, odd.s7), 0, out);
  vstore16((float16)(even.s8, odd.s8, even.s9, odd.s9, even.sa, odd.sa, even.sb, odd.sb, even.sc, odd.sc, even.sd, odd.sd, even.se,
                     odd.se, even.sf, odd.sf), 1, out);
  if (is_last) out[32] = after.sf;
}

#define LS_AT(p, n) vload16(0, (p) + (n))

/* One inverse step of CDF(2,2) for the square of coarse heights of each tile.
     parameters  headers as in ls_wavelet.h, tile n at first_header + n * header_step; details have one coefficient before the posts
     source      coarse heights at LS_H_SOURCE_AT, row stride LS_H_SOURCE_STRIDE;  out: at LS_H_OUT_AT, LS_H_OUT_STRIDE >= 33
   Writes fine columns 0 .. 32 * blocks of fine rows 0 .. 2 (rows - 1). A work-item walks down `strip` coarse rows and keeps the row
   above in registers. Work size: x = ceil(rows / strip) * blocks items, y = tile. */
LS_KERNEL void ls_inverse22(__global const uint* parameters, uint first_header, uint header_step, __global const float* source,
                            __global const float* detail, __global float* out, uint rows, uint blocks, uint strip) {
  __global const uint* h = parameters + first_header + get_global_id(1) * header_step;
  const uint item = get_global_id(0), row = item / blocks * strip, block = item % blocks, i = block * 16;
  if (row >= rows) return;
  const bool is_last = block + 1 == blocks;
  const int stride = h[LS_H_SOURCE_STRIDE], out_stride = h[LS_H_OUT_STRIDE];
  const uint below = rows - 1 - row; /* coarse rows after the first one */
  const uint pairs = min(strip, below);
  __global const float* c = source + h[LS_H_SOURCE_AT] + row * stride + i;
  __global float* fine = out + h[LS_H_OUT_AT] + row * 2 * out_stride + i * 2;
  float16 lo0 = LS_AT(c, 0), lo1 = LS_AT(c, 1);
  if (h[LS_H_MODE] == LS_MODE_LINEAR) {
    const float16 zero = (float16)(0.0f);
    for (uint n = 0; n < pairs; ++n) {
      c += stride;
      const float16 next0 = LS_AT(c, 0), next1 = LS_AT(c, 1);
      ls_store_row(fine, lo0, lo1, zero, zero, zero, is_last);
      ls_store_row(fine + out_stride, LS_ODD22(zero, lo0, next0), LS_ODD22(zero, lo1, next1), zero, zero, zero, is_last);
      lo0 = next0;
      lo1 = next1;
      fine += 2 * out_stride;
    }
    if (below < strip) ls_store_row(fine, lo0, lo1, zero, zero, zero, is_last);
    return;
  }
  const int plane = h[LS_H_PLANE], ds = h[LS_H_STRIDE];
  __global const float* d1 = detail + h[LS_H_DETAIL_AT] + (row + 1) * ds + i + 1;
  __global const float* d2 = d1 + plane;
  __global const float* d3 = d2 + plane;
  float16 v0 = LS_AT(d2, 0), v1 = LS_AT(d2, 1), x0 = LS_AT(d3, -1), x1 = LS_AT(d3, 0), x2 = LS_AT(d3, 1);
  lo0 = LS_EVEN22(lo0, LS_AT(d2, -ds), v0);
  lo1 = LS_EVEN22(lo1, LS_AT(d2, 1 - ds), v1);
  float16 hx0 = LS_EVEN22(LS_AT(d1, -1), LS_AT(d3, -1 - ds), x0), hx1 = LS_EVEN22(LS_AT(d1, 0), LS_AT(d3, -ds), x1),
          hx2 = LS_EVEN22(LS_AT(d1, 1), LS_AT(d3, 1 - ds), x2);
  for (uint n = 0; n < pairs; ++n) {
    c += stride;
    d1 += ds;
    d2 += ds;
    d3 += ds;
    ls_store_row(fine, lo0, lo1, hx0, hx1, hx2, is_last);
    const float16 w0 = LS_AT(d2, 0), w1 = LS_AT(d2, 1), y0 = LS_AT(d3, -1), y1 = LS_AT(d3, 0), y2 = LS_AT(d3, 1);
    const float16 next0 = LS_EVEN22(LS_AT(c, 0), v0, w0), next1 = LS_EVEN22(LS_AT(c, 1), v1, w1);
    const float16 hnext0 = LS_EVEN22(LS_AT(d1, -1), x0, y0), hnext1 = LS_EVEN22(LS_AT(d1, 0), x1, y1), hnext2 = LS_EVEN22(LS_AT(d1, 1), x2, y2);
    ls_store_row(fine + out_stride, LS_ODD22(v0, lo0, next0), LS_ODD22(v1, lo1, next1), LS_ODD22(x0, hx0, hnext0),
                 LS_ODD22(x1, hx1, hnext1), LS_ODD22(x2, hx2, hnext2), is_last);
    v0 = w0;
    v1 = w1;
    x0 = y0;
    x1 = y1;
    x2 = y2;
    lo0 = next0;
    lo1 = next1;
    hx0 = hnext0;
    hx1 = hnext1;
    hx2 = hnext2;
    fine += 2 * out_stride;
  }
  if (below < strip) ls_store_row(fine, lo0, lo1, hx0, hx1, hx2, is_last);
}

/* One inverse step of CDF(4,4) along one axis. Line n of tile t: coarse[t * coarse_tile + n * coarse_line + i * coarse_step], details
   likewise with two coefficients before the first coarse post; all from their *_at. coarse_tile = 0: LS_H_SOURCE_AT says where the
   tile's coarse posts are. The header's mode says whether the details count. Makes fine posts 0 .. 2 (count - 3) from coarse post 1 on.
   Work size: x = lines * (count - 2) items, y = tile. */
LS_KERNEL void ls_inverse44(__global const uint* parameters, uint first_header, uint header_step, __global const float* coarse,
                            uint coarse_at, uint coarse_tile, uint coarse_line, uint coarse_step, __global const float* detail,
                            uint detail_at, uint detail_tile, uint detail_line, uint detail_step, __global float* out, uint out_at,
                            uint out_tile, uint out_line, uint out_step, uint lines, uint count) {
  const uint tile = get_global_id(1), line = get_global_id(0) % lines, i = get_global_id(0) / lines + 1;
  if (i + 1 >= count) return;
  __global const uint* h = parameters + first_header + tile * header_step;
  const bool is_flat = h[LS_H_MODE] == LS_MODE_LINEAR;
  __global const float* c = coarse + coarse_at + (coarse_tile ? tile * coarse_tile : h[LS_H_SOURCE_AT]) + line * coarse_line + i * coarse_step;
  __global const float* p = detail + detail_at + tile * detail_tile + line * detail_line + (i + 2) * detail_step;
  const int cs = coarse_step, ds = detail_step;
  float d[6];
  for (int k = 0; k < 6; ++k) d[k] = is_flat ? 0.0f : p[(k - 3) * ds]; /* details i - 3 .. i + 2 */
  const float before = ls_s44(c[-cs], d[0], d[1], d[2], d[3]), here = ls_s44(c[0], d[1], d[2], d[3], d[4]),
              after = ls_s44(c[cs], d[2], d[3], d[4], d[5]);
  const float odd = ls_odd44(d[3], here, after);
  __global float* fine = out + out_at + tile * out_tile + line * out_line + (i - 1) * 2 * out_step;
  fine[0] = ls_even44(here, ls_odd44(d[2], before, here), odd);
  if (i + 2 < count) fine[out_step] = odd;
}

/* Index n mirrored into 0..last, for |n| < 3 last. */
LS_FN int ls_reflect(int n, int last) {
  const int period = 2 * last;
  const int m = ((n % period) + period) % period;
  return m <= last ? m : period - m;
}
/* The analysis of one line, sample by sample; x: first sample of the line. */
LS_FN float ls_sample(__global const float* x, int step, int last, int n) { return x[ls_reflect(n, last) * step]; }
LS_FN float ls_high22_at(__global const float* x, int step, int last, int i) {
  return LS_HIGH22(ls_sample(x, step, last, 2 * i + 1), ls_sample(x, step, last, 2 * i), ls_sample(x, step, last, 2 * i + 2));
}
LS_FN float ls_even_at(__global const float* x, int step, int last, int i) {
  return ls_sample(x, step, last, 2 * i) - (ls_sample(x, step, last, 2 * i - 1) + ls_sample(x, step, last, 2 * i + 1)) * 0.25f;
}
LS_FN float ls_high44_at(__global const float* x, int step, int last, int i) {
  return ls_sample(x, step, last, 2 * i + 1) - (ls_even_at(x, step, last, i) + ls_even_at(x, step, last, i + 1));
}

/* One analysis step along one axis: line n is in[n * line_step + k * step], k < count. low and high get ceil(count/2) and
   floor(count/2) values per line with their own steps. cubic: CDF(4,4). Work size: x = lines * ceil(count/2) items, y = 1. */
LS_KERNEL void ls_forward(__global const float* in, uint line_step, uint step, uint lines, uint count, uint cubic, __global float* low,
                          uint low_line, uint low_step, __global float* high, uint high_line, uint high_step) {
  const uint line = get_global_id(0) % lines;
  const int i = get_global_id(0) / lines, last = (int)count - 1, s = step;
  if (2 * i > last) return;
  __global const float* x = in + line * line_step;
  __global float* out_low = low + line * low_line + i * low_step;
  __global float* out_high = high + line * high_line + i * high_step;
  if (cubic) {
    const float before = ls_high44_at(x, s, last, i - 1), here = ls_high44_at(x, s, last, i);
    const float near = (before + here) * (29.0f / 128.0f);
    const float far = (ls_high44_at(x, s, last, i - 2) + ls_high44_at(x, s, last, i + 1)) * (5.0f / 128.0f);
    *out_low = (ls_even_at(x, s, last, i) + (near - far)) * 2.0f;
    if (2 * i + 1 <= last) *out_high = here * 0.5f;
  } else {
    const float here = ls_high22_at(x, s, last, i);
    *out_low = LS_LOW22(ls_sample(x, s, last, 2 * i), ls_high22_at(x, s, last, i - 1), here);
    if (2 * i + 1 <= last) *out_high = here;
  }
}
