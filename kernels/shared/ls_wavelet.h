/* Wavelet synthesis: arithmetic and data layout shared by the OpenCL kernels and the C++ twin.
   Source: SPEC-SYNTHESIS sections 2-4 (CDF(2,2) and CDF(4,4) lifting, sigma maps, mask guided reconstruction). */
#ifndef LS_WAVELET_H
#define LS_WAVELET_H

#include "kernels/shared/ls_platform.h"

/* CDF(2,2): x[2i] = c[i] - (d[i-1] + d[i]) / 4, x[2i+1] = d[i] + (x[2i] + x[2i+2]) / 2. */
#define LS_EVEN22(c, d_before, d_here) ((c) - ((d_before) + (d_here)) * 0.25f)
#define LS_ODD22(d, even_before, even_after) ((d) + ((even_before) + (even_after)) * 0.5f)
/* Analysis: d[i] = x[2i+1] - (x[2i] + x[2i+2]) / 2, c[i] = x[2i] + (d[i-1] + d[i]) / 4. */
#define LS_HIGH22(x, even_before, even_after) ((x) - ((even_before) + (even_after)) * 0.5f)
#define LS_LOW22(x, d_before, d_here) ((x) + ((d_before) + (d_here)) * 0.25f)

/* CDF(4,4): stored c = 2 s and d = (lifting d) / 2; d2.. are stored details at i-2, i-1, i, i+1. */
LS_FN float ls_s44(float c, float d_before2, float d_before, float d_here, float d_after) {
  const float near = (d_before * 2.0f + d_here * 2.0f) * (29.0f / 128.0f);
  const float far = (d_before2 * 2.0f + d_after * 2.0f) * (5.0f / 128.0f);
  return c * 0.5f - (near - far);
}
LS_FN float ls_odd44(float d, float s_here, float s_after) { return d * 2.0f + (s_here + s_after); }
LS_FN float ls_even44(float s, float odd_before, float odd_here) { return s + (odd_before + odd_here) * 0.25f; }

/* Position u (units of 2^-shift map entries, from the first of `count` entries) -> entry I and fraction f to entry I + 1.
   Smooth: I = min(floor(u), count - 2), f = u - I. Nearest: f = 0. u is clamped to the map; a map of one entry gives I = 0, f = 0. */
LS_FN int ls_map_entry(int u, int count, int shift, int nearest, LS_PRIVATE float* f) {
  const int last = (count - 1) << shift;
  const int inside = u < 0 ? 0 : (u > last ? last : u);
  int entry = (inside + (nearest ? (1 << shift) >> 1 : 0)) >> shift;
  const int limit = nearest || count < 2 ? count - 1 : count - 2;
  entry = entry > limit ? limit : entry;
  *f = nearest ? 0.0f : (float)(inside - (entry << shift)) * (1.0f / (float)(1 << shift));
  return entry;
}
LS_FN float ls_mix(float a, float b, float f) { return a + f * (b - a); }

/* A mask sum S counts energy up to LS_MASK_FULL * D; every pixel that protects adds at least LS_MASK_PROTECTS on top. */
#define LS_MASK_FULL 1020
#define LS_MASK_ENERGY_MIXED 276  /* D of bands 1 and 2: 46 * 6 */
#define LS_MASK_ENERGY_DIAGONAL 2116 /* D of band 3: 46 * 46 */
#define LS_MASK_PROTECTS (1 << 22)
/* A source entry: 0..1020 and a flag high enough that sums of values stay below the flags they collect. */
#define LS_MASK_PIXEL_VALUE 0xffff
#define LS_MASK_PIXEL_PROTECTS (1 << 16)
/* Sum of weights times entries along x -> the form that is summed along y. */
LS_FN int ls_mask_folded(int sum) { return (sum & LS_MASK_PIXEL_VALUE) + (sum > LS_MASK_PIXEL_VALUE ? LS_MASK_PROTECTS : 0); }
/* Record of one row of coefficients in the mask tables: first source row, their number n <= 6 (0: nothing to remove in the row),
   n weights as bytes in two words, first and end column that the mask can reach. */
#define LS_MASK_RECORD 6

/* Weight of source entry number n (0..5) for a coefficient. Fine cells X-3..X+2 in the odd direction, X-2..X+1 in the even one
   (each vertex of the squared taps 1 4 36 4 1 or 1 4 1 shares its value among its two cells), or, for a source of vertices,
   X-2..X+2 or X-1..X+1 themselves. */
LS_FN int ls_mask_weight(int n, int odd, int vertices) {
  if (vertices) return odd ? (n == 2 ? 36 : (n == 1 || n == 3 ? 4 : (n < 5 ? 1 : 0))) : (n == 1 ? 4 : (n < 3 ? 1 : 0));
  return odd ? (n == 2 || n == 3 ? 40 : (n == 1 || n == 4 ? 5 : 1)) : (n == 1 || n == 2 ? 5 : (n < 4 ? 1 : 0));
}
LS_FN int ls_mask_first(int odd, int vertices) { return vertices ? (odd ? -2 : -1) : (odd ? -3 : -2); }
LS_FN int ls_mask_count(int odd, int vertices) { return vertices ? (odd ? 5 : 3) : (odd ? 6 : 4); }

/* Header of one level of one tile: words of the parameter buffer. Offsets named _AT count words of that buffer unless said
   otherwise. Detail planes and all tables by column have LS_H_STRIDE columns; column 0 is coefficient BASE_I (see halo). */
enum {
  LS_H_MODE,       /* LS_MODE_ */
  LS_H_BLOCKS,     /* 16-wide blocks of a detail plane */
  LS_H_STRIDE,     /* columns of a detail plane, >= 16 */
  LS_H_DETAIL_AT,  /* first float of d1 in the detail buffer; d2 and d3 follow after LS_H_PLANE floats each */
  LS_H_PLANE,
  LS_H_BASE_I, /* global index of column 0 and row 0, modulo 2^32 */
  LS_H_BASE_J,
  LS_H_LEVEL,
  LS_H_SEED0,
  LS_H_SEED1,
  /* Index of each column (STRIDE + 16 entries, the last 16 repeat the first) and row (one more than there are) relative to BASE,
     mirrored at the border of the world: in the odd direction of a band and in the even one. */
  LS_H_COLUMNS_ODD_AT,
  LS_H_COLUMNS_EVEN_AT,
  LS_H_ROWS_ODD_AT,
  LS_H_ROWS_EVEN_AT,
  LS_H_SOURCE_AT, /* coarse heights in their buffer, floats */
  LS_H_SOURCE_STRIDE,
  LS_H_OUT_AT, /* fine heights in their buffer, floats */
  LS_H_OUT_STRIDE,
  LS_H_SIGMA,                        /* [3] GSA deviation, float bits */
  LS_H_MAP_AT = LS_H_SIGMA + 3,      /* [3] LSA: deviations of the map crop at this level, float bits */
  LS_H_MAP_WIDTH = LS_H_MAP_AT + 3,  /* [3] */
  LS_H_MAP_HEIGHT = LS_H_MAP_WIDTH + 3,       /* [3] */
  LS_H_MAP_U = LS_H_MAP_HEIGHT + 3,  /* [3] position of relative column index 0 in the map, 2^-shift entries */
  LS_H_MAP_SHIFT = LS_H_MAP_U + 3,
  LS_H_MAP_NEAREST,
  LS_H_MAP_ROWS_AT,                       /* [3] per row: entry, fraction (float bits) */
  LS_H_SIGMA_ROWS_AT = LS_H_MAP_ROWS_AT + 3, /* [3] in the sigma-row buffer: MAP_HEIGHT rows of STRIDE + 16 floats */
  LS_H_MASK_AT = LS_H_SIGMA_ROWS_AT + 3,     /* mask source, one word per entry; 0 = no mask */
  LS_H_MASK_WIDTH,
  LS_H_MASK_HEIGHT,
  LS_H_MASK_X,        /* fine column of relative index 0, counted from the first fine column of the source */
  LS_H_MASK_SHIFT,    /* fine columns per source entry, log2 */
  LS_H_MASK_VERTICES, /* 1: the source has one entry per fine vertex */
  LS_H_MASK_USED_AT,  /* per source row: first and end column whose sum is read */
  LS_H_MASK_ROWS_ODD_AT, /* LS_MASK_RECORD words per row */
  LS_H_MASK_ROWS_EVEN_AT,
  LS_H_MASK_SUMS_ODD_AT, /* in the mask-sum buffer: MASK_HEIGHT rows of STRIDE + 16 ints */
  LS_H_MASK_SUMS_EVEN_AT,
  LS_HEADER_WORDS
};

#define LS_MODE_LINEAR 0u /* no detail at all */
#define LS_MODE_GSA 1u
#define LS_MODE_LSA 2u

#endif
