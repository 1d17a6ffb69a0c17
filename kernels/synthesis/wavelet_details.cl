/* Detail coefficients of wavelet synthesis: GSA and LSA deviations, Gaussian, mask guided reconstruction.
   Sources: Perez et al. eq. 6, 8, 9; SPEC-SYNTHESIS 3.3, 3.5, 4. Twin: wavelet_host.cpp.
   Buffers
     parameters  uint words: one LS_H_ header per (tile, level), tile-major, then the tables that they point to
     sigma_rows  f32, LSA maps interpolated to the columns of the level, per header and band: MAP_HEIGHT rows of STRIDE + 16
     mask_sums   i32, mask source summed along x with the squared taps: MASK_HEIGHT rows of STRIDE + 16, odd and even columns
     detail      f32 metres, planes d1, d2, d3 of STRIDE columns, rows packed without gaps
   Rows of tables repeat their first 16 columns at the end, so that a block of 16 that runs into the next row is one plain load.
   Work size: x as said at each kernel, y = header number (times 3 bands). */
#include "kernels/shared/ls_random.h"
#include "kernels/shared/ls_wavelet.h"

/* sigma_rows: one work-item per column; y = header * 3 + band. */
LS_KERNEL void ls_sigma_rows(__global const uint* parameters, __global float* sigma_rows) {
  const uint band = get_global_id(1) % 3;
  __global const uint* h = parameters + get_global_id(1) / 3 * LS_HEADER_WORDS;
  const int column = get_global_id(0), stride = h[LS_H_STRIDE] + 16;
  if (h[LS_H_MODE] != LS_MODE_LSA || column >= stride) return;
  const int width = h[LS_H_MAP_WIDTH + band], height = h[LS_H_MAP_HEIGHT + band];
  const int relative = parameters[h[band == 1 ? LS_H_COLUMNS_EVEN_AT : LS_H_COLUMNS_ODD_AT] + column];
  float f;
  const int entry = ls_map_entry((int)h[LS_H_MAP_U + band] + 2 * relative, width, h[LS_H_MAP_SHIFT], h[LS_H_MAP_NEAREST], &f);
  const int next = entry + 1 < width ? entry + 1 : entry;
  __global const float* map = (__global const float*)(parameters + h[LS_H_MAP_AT + band]);
  __global float* out = sigma_rows + h[LS_H_SIGMA_ROWS_AT + band] + column;
  for (int row = 0; row < height; ++row) out[row * stride] = ls_mix(map[row * width + entry], map[row * width + next], f);
}

/* One column of mask sums; column: the one it stands for in a row without repeats. */
LS_FN void ls_sum_column(__global const uint* parameters, __global const uint* h, __global int* out, int stride, int column, int x, int odd) {
  const int vertices = h[LS_H_MASK_VERTICES], shift = h[LS_H_MASK_SHIFT], width = h[LS_H_MASK_WIDTH], height = h[LS_H_MASK_HEIGHT];
  const int n = ls_mask_count(odd, vertices), first = x >> shift, second = (x + n - 1) >> shift;
  __global const uint* source = parameters + h[LS_H_MASK_AT];
  __global const int* span = (__global const int*)(parameters + h[LS_H_MASK_USED_AT]);
  const bool is_narrow = second - first < 2; /* coarse pixels: at most two under the filter */
  int weight0 = 0, weight1 = 0;
  for (int k = 0; k < n; ++k) {
    const int weight = ls_mask_weight(k, odd, vertices);
    if ((x + k) >> shift == first) weight0 += weight;
    else weight1 += weight;
  }
  for (int row = 0; row < height; ++row, source += width, span += 2, out += stride) {
    if (column < span[0] || column >= span[1]) continue;
    int sum = 0;
    if (is_narrow) sum = weight0 * (int)source[first] + weight1 * (int)source[second];
    else
      for (int k = 0; k < n; ++k) sum += ls_mask_weight(k, odd, vertices) * (int)source[(x + k) >> shift];
    *out = ls_mask_folded(sum);
  }
}

/* mask_sums: one work-item per column; y = header. */
LS_KERNEL void ls_mask_rows(__global const uint* parameters, __global int* mask_sums) {
  __global const uint* h = parameters + get_global_id(1) * LS_HEADER_WORDS;
  const int column = get_global_id(0), stride = h[LS_H_STRIDE] + 16;
  if (h[LS_H_MASK_AT] == 0 || column >= stride) return;
  const int vertices = h[LS_H_MASK_VERTICES], x = h[LS_H_MASK_X], plain = column < stride - 16 ? column : column - (stride - 16);
  const int odd_x = x + 2 * (int)parameters[h[LS_H_COLUMNS_ODD_AT] + column] + 1 + ls_mask_first(1, vertices);
  const int even_x = x + 2 * (int)parameters[h[LS_H_COLUMNS_EVEN_AT] + column] + ls_mask_first(0, vertices);
  ls_sum_column(parameters, h, mask_sums + h[LS_H_MASK_SUMS_ODD_AT] + column, stride, plain, odd_x, 1);
  ls_sum_column(parameters, h, mask_sums + h[LS_H_MASK_SUMS_EVEN_AT] + column, stride, plain, even_x, 0);
}

/* Mask energy of sixteen coefficients of one row (a record), the first one in `column`: `sums` are those of the first source row. */
LS_FN int16 ls_mask_block(__global const uint* record, __global const int* sums, uint stride, int column) {
  int16 total = (int16)(0);
  const uint n = record[1];
  if (n == 0 || column + 16 <= (int)record[4] || column >= (int)record[5]) return total;
  uint weights = record[2];
  sums += record[0] * stride;
  for (uint k = 0; k < n; ++k, sums += stride) {
    total += (int)(weights & 255u) * vload16(0, sums);
    weights = k == 3 ? record[3] : weights >> 8;
  }
  return total;
}

/* The same for a block whose lanes `next` lie in the following row: there it starts `column - columns` before the first one. */
LS_FN int16 ls_mask_lanes(__global const uint* rows, uint row, __global const int* sums, uint columns, int column, int16 next) {
  __global const uint* record = rows + row * LS_MASK_RECORD;
  const int16 here = ls_mask_block(record, sums + column, columns + 16, column);
  if (column + 16 <= (int)columns) return here;
  return select(here, ls_mask_block(record + LS_MASK_RECORD, sums + column, columns + 16, column - (int)columns), next);
}

/* LSA deviation of sixteen coefficients: rows of (entry, fraction), sigma rows at the block's first column. */
LS_FN float16 ls_sigma_block(__global const uint* row, __global const float* sigma_rows, uint stride, uint height) {
  const uint entry = row[0], next = entry + 1 < height ? entry + 1 : entry;
  const float16 top = vload16(0, sigma_rows + entry * stride), bot = vload16(0, sigma_rows + next * stride);
  return top + as_float(row[1]) * (bot - top);
}
LS_FN float16 ls_sigma_lanes(__global const uint* rows, uint row, __global const float* sigma_rows, uint stride, uint height, int16 next,
                             bool crosses) {
  const float16 here = ls_sigma_block(rows + row * 2, sigma_rows, stride, height);
  return crosses ? select(here, ls_sigma_block(rows + (row + 1) * 2, sigma_rows, stride, height), next) : here;
}

LS_FN int ls_or16(int16 v) {
  const int8 a = v.lo | v.hi;
  const int4 b = a.lo | a.hi;
  const int2 c = b.lo | b.hi;
  return c.x | c.y;
}

/* d * sqrt((full - S) / full), +0 where S reaches full. */
LS_FN float16 ls_keep(float16 d, int16 removed, int full) {
  const float16 keep = sqrt(convert_float16(max(full - removed, (int16)(0))) / (float)full);
  return select(d * keep, (float16)(0.0f), removed >= full);
}

/* One band of one block: nothing to remove, all removed, or in between. */
LS_FN void ls_store_band(__global float* out, float16 sigma, uint16 i, uint16 j, uint stream, uint k0, uint k1, int16 removed, int full) {
  if (ls_or16(removed < full) == 0) {
    vstore16((float16)(0.0f), 0, out);
    return;
  }
  float16 d = sigma * ls_gaussian16(i, j, stream, k0, k1);
  if (ls_or16(removed)) d = ls_keep(d, removed, full);
  vstore16(d, 0, out);
}

/* detail: one work-item per block of 16 coefficients of all three bands; y = header. */
LS_KERNEL void ls_details(__global const uint* parameters, __global const float* sigma_rows, __global const int* mask_sums,
                          __global float* detail) {
  __global const uint* h = parameters + get_global_id(1) * LS_HEADER_WORDS;
  const uint block = get_global_id(0), mode = h[LS_H_MODE];
  if (mode == LS_MODE_LINEAR || block >= h[LS_H_BLOCKS]) return;
  const uint stride = h[LS_H_STRIDE];
  const uint row = block * 16 / stride, column = block * 16 - row * stride;
  const bool crosses = column + 16 > stride;
  const int16 lane = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const int16 next = lane >= (int)(stride - column);
  const uint k0 = h[LS_H_SEED0], k1 = h[LS_H_SEED1], stream = ls_stream(h[LS_H_LEVEL], 0, LS_ALGO_WAVELET, 0);
  const uint16 i_odd = h[LS_H_BASE_I] + vload16(0, parameters + h[LS_H_COLUMNS_ODD_AT] + column);
  const uint16 i_even = h[LS_H_BASE_I] + vload16(0, parameters + h[LS_H_COLUMNS_EVEN_AT] + column);
  __global const uint* rows_odd = parameters + h[LS_H_ROWS_ODD_AT] + row;
  __global const uint* rows_even = parameters + h[LS_H_ROWS_EVEN_AT] + row;
  const uint16 j_odd = h[LS_H_BASE_J] + select((uint16)(rows_odd[0]), (uint16)(rows_odd[1]), next);
  const uint16 j_even = h[LS_H_BASE_J] + select((uint16)(rows_even[0]), (uint16)(rows_even[1]), next);

  float16 sigma1 = (float16)(as_float(h[LS_H_SIGMA])), sigma2 = (float16)(as_float(h[LS_H_SIGMA + 1])),
          sigma3 = (float16)(as_float(h[LS_H_SIGMA + 2]));
  if (mode == LS_MODE_LSA) {
    sigma1 = ls_sigma_lanes(parameters + h[LS_H_MAP_ROWS_AT], row, sigma_rows + h[LS_H_SIGMA_ROWS_AT] + column, stride + 16,
                            h[LS_H_MAP_HEIGHT], next, crosses);
    sigma2 = ls_sigma_lanes(parameters + h[LS_H_MAP_ROWS_AT + 1], row, sigma_rows + h[LS_H_SIGMA_ROWS_AT + 1] + column, stride + 16,
                            h[LS_H_MAP_HEIGHT + 1], next, crosses);
    sigma3 = ls_sigma_lanes(parameters + h[LS_H_MAP_ROWS_AT + 2], row, sigma_rows + h[LS_H_SIGMA_ROWS_AT + 2] + column, stride + 16,
                            h[LS_H_MAP_HEIGHT + 2], next, crosses);
  }

  __global float* out = detail + h[LS_H_DETAIL_AT] + block * 16;
  const uint plane = h[LS_H_PLANE];
  if (h[LS_H_MASK_AT] != 0) {
    __global const int* sums_odd = mask_sums + h[LS_H_MASK_SUMS_ODD_AT];
    __global const int* sums_even = mask_sums + h[LS_H_MASK_SUMS_EVEN_AT];
    __global const uint* mask_odd = parameters + h[LS_H_MASK_ROWS_ODD_AT];
    __global const uint* mask_even = parameters + h[LS_H_MASK_ROWS_EVEN_AT];
    const int16 s1 = ls_mask_lanes(mask_even, row, sums_odd, stride, column, next);
    const int16 s2 = ls_mask_lanes(mask_odd, row, sums_even, stride, column, next);
    const int16 s3 = ls_mask_lanes(mask_odd, row, sums_odd, stride, column, next);
    if (ls_or16(s1 | s2 | s3)) {
      ls_store_band(out, sigma1, i_odd, j_even, stream | 1u << 8, k0, k1, s1, LS_MASK_FULL * LS_MASK_ENERGY_MIXED);
      ls_store_band(out + plane, sigma2, i_even, j_odd, stream | 2u << 8, k0, k1, s2, LS_MASK_FULL * LS_MASK_ENERGY_MIXED);
      ls_store_band(out + 2 * plane, sigma3, i_odd, j_odd, stream | 3u << 8, k0, k1, s3, LS_MASK_FULL * LS_MASK_ENERGY_DIAGONAL);
      return;
    }
  }
  vstore16(sigma1 * ls_gaussian16(i_odd, j_even, stream | 1u << 8, k0, k1), 0, out);
  vstore16(sigma2 * ls_gaussian16(i_even, j_odd, stream | 2u << 8, k0, k1), 0, out + plane);
  vstore16(sigma3 * ls_gaussian16(i_odd, j_odd, stream | 3u << 8, k0, k1), 0, out + 2 * plane);
}
