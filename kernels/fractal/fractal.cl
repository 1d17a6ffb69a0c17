/* Midpoint displacement and the fractal wavelet: one kernel per operation of kernels/fractal/fractal_plan.h.
   Work size: items in x, rows in y. Kernels that begin with LS_BLOCK: one work-item per 16 items of a row, all rows in x; the
   vectors that PoCL makes of them by itself were three times slower.
   g: the step (kernels/shared/ls_fractal.h). Planes: float32, metres, LS_FRACTAL_GUARD unused floats first. */
#include "kernels/shared/ls_fractal.h"

#define LS_IN __global const float*
#define LS_OUT __global float*
#define LS_ITEM                                                                \
  const int i = (int)get_global_id(0), j = (int)get_global_id(1);              \
  if (i >= g.width) return;
#define LS_BLOCK                                                                                                  \
  const int block = (int)get_global_id(0), blocks = (g.width + 15) / 16, j = block / blocks, i = (block - j * blocks) * 16; \
  if (j >= g.height) return;
/* Stores a0 b0 a1 b1 .. */
#define LS_STORE_PAIRS(a, b, at)                                                                                     \
  vstore16((float16)(a.s0, b.s0, a.s1, b.s1, a.s2, b.s2, a.s3, b.s3, a.s4, b.s4, a.s5, b.s5, a.s6, b.s6, a.s7, b.s7), 0, at);  \
  vstore16((float16)(a.s8, b.s8, a.s9, b.s9, a.sa, b.sa, a.sb, b.sb, a.sc, b.sc, a.sd, b.sd, a.se, b.se, a.sf, b.sf), 0, (at) + 16);
#define LS_EVEN(lo, hi) (float16)(lo.even, hi.even)
#define LS_ODD(lo, hi) (float16)(lo.odd, hi.odd)
#define LS_QUARTER(a, b) ((a + (a + b) * 0.5f) * 0.5f)
#define LS_AT(plane) ((plane) + LS_FRACTAL_GUARD)

LS_KERNEL void ls_fractal_node_rows(const ls_step g, LS_IN table, LS_OUT rows) {
  LS_ITEM
  ls_node_row(&g, i, j, LS_AT(table), LS_AT(rows));
}

/* ls_displacement() of sixteen items. */
LS_KERNEL void ls_fractal_noise(const ls_step g, LS_IN rows, LS_OUT delta) {
  LS_BLOCK
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

/* ls_square_next_inner() of sixteen items. */
LS_KERNEL void ls_fractal_square_next_inner(const ls_step g, LS_IN parent, LS_IN delta, LS_OUT out) {
  LS_BLOCK
  LS_IN m = LS_AT(parent) + g.parent_at + j * g.parent_pitch + i;
  LS_IN u = m - g.parent_pitch;
  LS_IN d = m + g.parent_pitch;
  const float16 cm = vload16(0, m), cu = vload16(0, u), cd = vload16(0, d);
  const float16 lm = vload16(0, m - 1), lu = vload16(0, u - 1), ld = vload16(0, d - 1);
  const float16 rm = vload16(0, m + 1), ru = vload16(0, u + 1), rd = vload16(0, d + 1);
  const float16 wm = LS_QUARTER(cm, lm), em = LS_QUARTER(cm, rm), wu = LS_QUARTER(cu, lu), eu = LS_QUARTER(cu, ru);
  const float16 wd = LS_QUARTER(cd, ld), ed = LS_QUARTER(cd, rd);
  const int north = 2 * j * 2 * g.pitch + 2 * i, south = north + 2 * g.pitch;
  const float16 n0 = vload16(0, LS_AT(delta) + north), n1 = vload16(1, LS_AT(delta) + north);
  const float16 s0 = vload16(0, LS_AT(delta) + south), s1 = vload16(1, LS_AT(delta) + south);
  const float16 nw = LS_QUARTER(wm, wu) + LS_EVEN(n0, n1), ne = LS_QUARTER(em, eu) + LS_ODD(n0, n1);
  const float16 sw = LS_QUARTER(wm, wd) + LS_EVEN(s0, s1), se = LS_QUARTER(em, ed) + LS_ODD(s0, s1);
  LS_STORE_PAIRS(nw, ne, LS_AT(out) + north)
  LS_STORE_PAIRS(sw, se, LS_AT(out) + south)
}

LS_KERNEL void ls_fractal_square_posts_inner(const ls_step g, LS_IN cells, LS_OUT out) {
  LS_ITEM
  ls_square_post_inner(&g, i, j, LS_AT(cells), LS_AT(out));
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

/* ls_diamond_quad() of sixteen items that have all neighbours. */
LS_KERNEL void ls_fractal_diamond_quads_inner(const ls_step g, LS_IN parent, LS_IN centres, LS_IN horizontal, LS_IN vertical,
                                              LS_OUT out) {
  LS_BLOCK
  LS_IN p = LS_AT(parent) + g.parent_at + j * g.parent_pitch + i;
  const int at = j * g.pitch + i;
  const float16 old = vload16(0, p), right = vload16(0, p + 1), below = vload16(0, p + g.parent_pitch);
  const float16 c = vload16(0, LS_AT(centres) + at), west = vload16(0, LS_AT(centres) + at - 1);
  const float16 north = vload16(0, LS_AT(centres) + at - g.pitch);
  const float16 across = ((old + right) + (north + c)) * 0.25f + vload16(0, LS_AT(horizontal) + at);
  const float16 down = ((old + below) + (west + c)) * 0.25f + vload16(0, LS_AT(vertical) + at);
  const int n = 2 * j * 2 * g.pitch + 2 * i;
  LS_STORE_PAIRS(old, across, LS_AT(out) + n)
  LS_STORE_PAIRS(down, c, LS_AT(out) + n + 2 * g.pitch)
}

LS_KERNEL void ls_fractal_rule_centres(const ls_step g, LS_IN parent, LS_OUT delta) {
  LS_ITEM
  ls_rule_centre(&g, i, j, LS_AT(parent), LS_AT(delta));
}

LS_KERNEL void ls_fractal_weights(const ls_step g, LS_IN delta, LS_OUT weights) {
  LS_ITEM
  ls_weight(&g, i, j, LS_AT(delta), LS_AT(weights));
}

/* ls_weight() of sixteen items away from the border. */
LS_KERNEL void ls_fractal_weights_inner(const ls_step g, LS_IN delta, LS_OUT weights) {
  LS_BLOCK
  const int at = j * g.pitch + i;
  vstore16(ls_theta(&g, i, j) * vload16(0, LS_AT(delta) + at), 0, LS_AT(weights) + at);
}

/* ls_half1_post() of sixteen items. */
LS_KERNEL void ls_fractal_half1_posts(const ls_step g, LS_IN parent, LS_IN weights, LS_OUT posts) {
  LS_BLOCK
  const int at = j * g.pitch + i;
  LS_IN w = LS_AT(weights) + at;
  LS_IN up = w - g.pitch;
  vstore16(vload16(0, LS_AT(parent) + g.parent_at + j * g.parent_pitch + i) -
               ((vload16(0, up - 1) + vload16(0, up)) + (vload16(0, w - 1) + vload16(0, w))),
           0, LS_AT(posts) + at);
}

/* ls_half1_centre() of sixteen items. */
LS_KERNEL void ls_fractal_half1_centres(const ls_step g, LS_IN posts, LS_IN delta, LS_OUT centres) {
  LS_BLOCK
  const int at = j * g.pitch + i;
  LS_IN p = LS_AT(posts) + at;
  LS_IN down = p + g.pitch;
  const float16 falling = (vload16(0, p) + vload16(0, down + 1)) * 0.5f, rising = (vload16(0, p + 1) + vload16(0, down)) * 0.5f;
  const int16 lane = (int16)(0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1);
  const int16 odd = ((lane + (g.parity + j)) & 1) == 1;
  vstore16(select(falling, rising, odd) + vload16(0, LS_AT(delta) + at), 0, LS_AT(centres) + at);
}

LS_KERNEL void ls_fractal_rule_edges(const ls_step g, LS_IN posts, LS_IN centres, LS_OUT delta) {
  LS_ITEM
  ls_rule_edge(&g, i, j, LS_AT(posts), LS_AT(centres), LS_AT(delta));
}

/* ls_half2_old() of sixteen items. */
LS_KERNEL void ls_fractal_half2_old(const ls_step g, LS_IN posts, LS_IN centres, LS_IN weights1, LS_IN weights2, LS_OUT posts2,
                                    LS_OUT centres2) {
  LS_BLOCK
  const int at = j * g.pitch + i;
  LS_IN w1 = LS_AT(weights1) + at;
  LS_IN w2 = LS_AT(weights2) + at;
  const float16 here1 = vload16(0, w1), here2 = vload16(0, w2);
  const float16 posts_share = (vload16(0, w1 - 1) + here1) + (vload16(0, w2 - g.pitch) + here2);
  const float16 centres_share = (here1 + vload16(0, w1 + g.pitch)) + (here2 + vload16(0, w2 + 1));
  vstore16(vload16(0, LS_AT(posts) + at) - posts_share, 0, LS_AT(posts2) + at);
  vstore16(vload16(0, LS_AT(centres) + at) - centres_share, 0, LS_AT(centres2) + at);
}

/* ls_half2_quad() of sixteen items. */
LS_KERNEL void ls_fractal_half2_quads(const ls_step g, LS_IN posts2, LS_IN centres2, LS_IN delta1, LS_IN delta2, LS_OUT out) {
  LS_BLOCK
  const int at = j * g.pitch + i, n = 2 * j * 2 * g.pitch + 2 * i;
  const float16 old = vload16(0, LS_AT(posts2) + at), c = vload16(0, LS_AT(centres2) + at);
  const float16 across = (old + vload16(0, LS_AT(posts2) + at + 1)) * 0.5f + vload16(0, LS_AT(delta1) + at);
  const float16 down = (old + vload16(0, LS_AT(posts2) + at + g.pitch)) * 0.5f + vload16(0, LS_AT(delta2) + at);
  LS_STORE_PAIRS(old, across, LS_AT(out) + n)
  LS_STORE_PAIRS(down, c, LS_AT(out) + n + 2 * g.pitch)
}
