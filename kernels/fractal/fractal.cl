/* Midpoint displacement and the fractal wavelet: one kernel per operation of kernels/fractal/fractal_plan.h.
   Work size: items in x (ls_fractal_noise: 16 items per work-item), rows in y.
   g: the step (kernels/shared/ls_fractal.h). Planes: float32, metres, LS_FRACTAL_GUARD unused floats first. */
#include "kernels/shared/ls_fractal.h"

#define LS_IN __global const float*
#define LS_OUT __global float*
#define LS_ITEM                                                                \
  const int i = (int)get_global_id(0), j = (int)get_global_id(1);              \
  if (i >= g.width) return;
#define LS_AT(plane) ((plane) + LS_FRACTAL_GUARD)

LS_KERNEL void ls_fractal_node_rows(const ls_step g, LS_IN table, LS_OUT rows) {
  LS_ITEM
  ls_node_row(&g, i, j, LS_AT(table), LS_AT(rows));
}

/* ls_displacement() of sixteen items. */
LS_KERNEL void ls_fractal_noise(const ls_step g, LS_IN rows, LS_OUT delta) {
  const int i = (int)get_global_id(0) * 16, j = (int)get_global_id(1);
  if (i >= g.width) return;
  const ls_node_pair p = ls_node_rows_at(&g, j);
  const float16 top = vload16(0, LS_AT(rows) + p.n0 * g.pitch + i), bottom = vload16(0, LS_AT(rows) + p.n1 * g.pitch + i);
  const float16 deviation = top + p.f * (bottom - top);
  const int16 column = i + (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const int is_row_inside = j >= g.lo_j && j <= ls_band_hi_j(&g) ? -1 : 0;
  const int16 inside = (column >= g.lo_i) & (column <= ls_band_hi_i(&g)) & is_row_inside;
  const float16 value = deviation * ls_gaussian16(g.i0 + as_uint16(column), (uint16)(g.j0 + (uint)j), g.stream, g.k0, g.k1);
  vstore16(select((float16)(0.0f), value, inside), 0, LS_AT(delta) + j * g.pitch + i);
}

LS_KERNEL void ls_fractal_scale(const ls_step g, LS_IN keep, LS_OUT delta) {
  LS_ITEM
  ls_scale(&g, i, j, LS_AT(keep), LS_AT(delta));
}

LS_KERNEL void ls_fractal_square_first(const ls_step g, LS_IN parent, LS_IN delta, LS_OUT out) {
  LS_ITEM
  ls_square_first(&g, i, j, LS_AT(parent), LS_AT(delta), LS_AT(out));
}

LS_KERNEL void ls_fractal_square_next(const ls_step g, LS_IN parent, LS_IN delta, LS_OUT out) {
  LS_ITEM
  ls_square_next(&g, i, j, LS_AT(parent), LS_AT(delta), LS_AT(out));
}

LS_KERNEL void ls_fractal_square_posts(const ls_step g, LS_IN cells, LS_OUT out) {
  LS_ITEM
  ls_square_post(&g, i, j, LS_AT(cells), LS_AT(out));
}

LS_KERNEL void ls_fractal_diamond_centres(const ls_step g, LS_IN parent, LS_IN delta, LS_OUT centres) {
  LS_ITEM
  ls_diamond_centre(&g, i, j, LS_AT(parent), LS_AT(delta), LS_AT(centres));
}

LS_KERNEL void ls_fractal_diamond_quads(const ls_step g, LS_IN parent, LS_IN centres, LS_IN horizontal, LS_IN vertical,
                                        LS_OUT out) {
  LS_ITEM
  ls_diamond_quad(&g, i, j, LS_AT(parent), LS_AT(centres), LS_AT(horizontal), LS_AT(vertical), LS_AT(out));
}

LS_KERNEL void ls_fractal_rule_centres(const ls_step g, LS_IN parent, LS_OUT delta) {
  LS_ITEM
  ls_rule_centre(&g, i, j, LS_AT(parent), LS_AT(delta));
}

LS_KERNEL void ls_fractal_weights(const ls_step g, LS_IN delta, LS_OUT weights) {
  LS_ITEM
  ls_weight(&g, i, j, LS_AT(delta), LS_AT(weights));
}

LS_KERNEL void ls_fractal_half1_posts(const ls_step g, LS_IN parent, LS_IN weights, LS_OUT posts) {
  LS_ITEM
  ls_half1_post(&g, i, j, LS_AT(parent), LS_AT(weights), LS_AT(posts));
}

LS_KERNEL void ls_fractal_half1_centres(const ls_step g, LS_IN posts, LS_IN delta, LS_OUT centres) {
  LS_ITEM
  ls_half1_centre(&g, i, j, LS_AT(posts), LS_AT(delta), LS_AT(centres));
}

LS_KERNEL void ls_fractal_rule_edges(const ls_step g, LS_IN posts, LS_IN centres, LS_OUT delta) {
  LS_ITEM
  ls_rule_edge(&g, i, j, LS_AT(posts), LS_AT(centres), LS_AT(delta));
}

LS_KERNEL void ls_fractal_half2_old(const ls_step g, LS_IN posts, LS_IN centres, LS_IN weights1, LS_IN weights2, LS_OUT posts2,
                                    LS_OUT centres2) {
  LS_ITEM
  ls_half2_old(&g, i, j, LS_AT(posts), LS_AT(centres), LS_AT(weights1), LS_AT(weights2), LS_AT(posts2), LS_AT(centres2));
}

LS_KERNEL void ls_fractal_half2_quads(const ls_step g, LS_IN posts2, LS_IN centres2, LS_IN delta1, LS_IN delta2, LS_OUT out) {
  LS_ITEM
  ls_half2_quad(&g, i, j, LS_AT(posts2), LS_AT(centres2), LS_AT(delta1), LS_AT(delta2), LS_AT(out));
}
