/* Midpoint displacement and the fractal wavelet, one work-item's share at a time: the C++ twin loops over these functions, the
   kernels call them once per work-item, so both give the same bits.
   Sources: Hu & Wang (square-square after Miller, diamond-square), Ostrowski (fractal wavelet); SPEC-SYNTHESIS sections 5, 6.

   A step leads from level s to s + 1. Items are parent indices (i, j) of a rectangle, `width` x `height`, row pitch `pitch`;
   outputs have twice the items in each direction and twice the pitch. The rectangle may reach beyond the world and beyond the
   heights that are known: what is computed there is never used. Planes have a guard of unused floats before and after them. */
#ifndef LS_FRACTAL_H
#define LS_FRACTAL_H

#include "kernels/shared/ls_random.h"

#if defined(__OPENCL_VERSION__) || defined(__OPENCL_C_VERSION__)
#define LS_GLOBAL __global
typedef long ls_long;
#else
#define LS_GLOBAL
typedef std::int64_t ls_long;
#endif

#define LS_FRACTAL_GUARD 4608 /* a row of the widest parent plane and more */

/* One step's geometry, rules and noise. */
typedef struct {
  ls_long node_x0, node_y0; /* node coordinate of item (0, 0), times 2^node_shift; two consecutive items differ by 2 */
  int width, height, pitch; /* items */
  int parent_at, parent_pitch; /* where item (0, 0) lies in the parent plane */
  int lo_i, hi_i, lo_j, hi_j;  /* the world's first and last posts (square-square: cells), as items */
  int parity;                  /* (i + j) & 1 of item (0, 0), global */
  /* noise of one band */
  int band;                    /* 0 square-square, 1 horizontal edges, 2 vertical edges, 3 centres */
  float node_scale; /* 2^-node_shift */
  int node_shift, node_smooth; /* node_smooth 0: mean of the nodes that touch the point */
  int nodes_x, nodes_y;        /* of the whole layer */
  int crop_x, crop_y, crop_w, crop_h, table_at;
  ls_uint i0, j0, stream, k0, k1; /* low words of item (0, 0)'s global index; counter and key of the generator */
  /* rules of the fractal wavelet */
  int is_published, is_near_border;
  int has_altitude, has_cap, has_erosion, has_water;
  float altitude_z0, altitude_scale, altitude_lo, altitude_span, cap_m, water_m;
} ls_step;

LS_FN int ls_clamp_int(int v, int lo, int hi) { return v < lo ? lo : (v > hi ? hi : v); }

/* Two nodes of one axis and the weight of the second. t: node coordinate (centre of node 0 = 0 in smooth lookup, border of node 0
   = 0 in the other) times 2^shift; scale: 2^-shift. Indices are relative to the crop and clamped to it. */
typedef struct {
  int n0, n1;
  float f;
} ls_node_pair;

LS_FN ls_node_pair ls_nodes_at(ls_long t, int shift, float scale, int is_smooth, int nodes, int crop, int crop_count) {
  ls_node_pair p;
  ls_long n0 = t >> shift, n1 = n0;
  float f = 0.0f;
  if (is_smooth) {
    if (t < 0) {
      n0 = 0;
      n1 = nodes > 1 ? 1 : 0;
    } else if (nodes < 2) {
      n0 = n1 = 0;
    } else if (n0 > nodes - 2) {
      n0 = nodes - 2;
      n1 = nodes - 1;
      f = 1.0f;
    } else {
      n1 = n0 + 1;
      f = (float)(int)(t - (n0 << shift)) * scale;
    }
  } else {
    if (n0 > 0 && t == (n0 << shift)) {
      n0 = n0 - 1;
      f = 0.5f;
    }
    if (n1 > nodes - 1) n1 = nodes - 1;
    if (n0 > nodes - 1) n0 = nodes - 1;
  }
  n0 -= crop;
  n1 -= crop;
  p.n0 = n0 < 0 ? 0 : (n0 > crop_count - 1 ? crop_count - 1 : (int)n0);
  p.n1 = n1 < 0 ? 0 : (n1 > crop_count - 1 ? crop_count - 1 : (int)n1);
  p.f = f;
  return p;
}

/* rows[r][i]: deviations of node row r, interpolated at item column i. */
LS_FN void ls_node_row(const ls_step* g, int i, int r, const LS_GLOBAL float* table, LS_GLOBAL float* rows) {
  const ls_node_pair p =
      ls_nodes_at(g->node_x0 + 2 * (ls_long)i, g->node_shift, g->node_scale, g->node_smooth, g->nodes_x, g->crop_x, g->crop_w);
  const LS_GLOBAL float* a = table + g->table_at + r * g->crop_w;
  rows[r * g->pitch + i] = a[p.n0] + p.f * (a[p.n1] - a[p.n0]);
}

LS_FN ls_node_pair ls_node_rows_at(const ls_step* g, int j) {
  return ls_nodes_at(g->node_y0 + 2 * (ls_long)j, g->node_shift, g->node_scale, g->node_smooth, g->nodes_y, g->crop_y, g->crop_h);
}

/* Last valid item of the band in x and y: cells end one before posts. */
LS_FN int ls_band_hi_i(const ls_step* g) { return g->hi_i - (g->band & 1); }
LS_FN int ls_band_hi_j(const ls_step* g) { return g->hi_j - (g->band >> 1); }

/* Displacement before any rule: deviation * Gaussian, 0 outside the world. */
LS_FN float ls_displacement(const ls_step* g, int i, int j, const LS_GLOBAL float* rows) {
  const ls_node_pair p = ls_node_rows_at(g, j);
  const float top = rows[p.n0 * g->pitch + i], bottom = rows[p.n1 * g->pitch + i];
  const float deviation = top + p.f * (bottom - top);
  const int inside = i >= g->lo_i && i <= ls_band_hi_i(g) && j >= g->lo_j && j <= ls_band_hi_j(g);
  const float value = deviation * ls_gaussian(g->i0 + (ls_uint)i, g->j0 + (ls_uint)j, g->stream, g->k0, g->k1);
  return inside ? value : 0.0f;
}

/* keep: from table_at, same pitch as the displacements. */
LS_FN void ls_scale(const ls_step* g, int i, int j, const LS_GLOBAL float* keep, LS_GLOBAL float* dh) {
  const int at = j * g->pitch + i;
  dh[at] = dh[at] * keep[g->table_at + at];
}

/* ---- square-square ---- */

/* 3/4 a + 1/4 b */
LS_FN float ls_quarter(float a, float b) { return (a + (a + b) * 0.5f) * 0.5f; }

/* First step: item = data cell, outputs its four quarter points. */
LS_FN void ls_square_first(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, const LS_GLOBAL float* noise,
                           LS_GLOBAL float* out) {
  const int at = g->parent_at + j * g->parent_pitch + i;
  const float nw = parent[at], ne = parent[at + 1];
  const float sw = parent[at + g->parent_pitch], se = parent[at + g->parent_pitch + 1];
  const float w0 = ls_quarter(nw, ne), e0 = ls_quarter(ne, nw), w1 = ls_quarter(sw, se), e1 = ls_quarter(se, sw);
  const int n = 2 * j * 2 * g->pitch + 2 * i, s = n + 2 * g->pitch;
  out[n] = ls_quarter(w0, w1) + noise[n];
  out[n + 1] = ls_quarter(e0, e1) + noise[n + 1];
  out[s] = ls_quarter(w1, w0) + noise[s];
  out[s + 1] = ls_quarter(e1, e0) + noise[s + 1];
}

/* Later steps: item = parent cell; neighbours beyond the world are the cell itself. has_w ..: which neighbours exist. */
LS_FN void ls_square_quad(const ls_step* g, int i, int j, int has_w, int has_e, int has_n, int has_s,
                          const LS_GLOBAL float* parent, const LS_GLOBAL float* noise, LS_GLOBAL float* out) {
  const int m = g->parent_at + j * g->parent_pitch + i, u = m - g->parent_pitch, d = m + g->parent_pitch;
  const float wm = ls_quarter(parent[m], has_w ? parent[m - 1] : parent[m]);
  const float em = ls_quarter(parent[m], has_e ? parent[m + 1] : parent[m]);
  const float wu = ls_quarter(parent[u], has_w ? parent[u - 1] : parent[u]);
  const float eu = ls_quarter(parent[u], has_e ? parent[u + 1] : parent[u]);
  const float wd = ls_quarter(parent[d], has_w ? parent[d - 1] : parent[d]);
  const float ed = ls_quarter(parent[d], has_e ? parent[d + 1] : parent[d]);
  const int n = 2 * j * 2 * g->pitch + 2 * i, s = n + 2 * g->pitch;
  out[n] = ls_quarter(wm, has_n ? wu : wm) + noise[n];
  out[n + 1] = ls_quarter(em, has_n ? eu : em) + noise[n + 1];
  out[s] = ls_quarter(wm, has_s ? wd : wm) + noise[s];
  out[s + 1] = ls_quarter(em, has_s ? ed : em) + noise[s + 1];
}

LS_FN void ls_square_next(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, const LS_GLOBAL float* noise,
                          LS_GLOBAL float* out) {
  ls_square_quad(g, i, j, i > g->lo_i, i < g->hi_i, j > g->lo_j, j < g->hi_j, parent, noise, out);
}

/* ls_square_next() where every neighbour exists. */
LS_FN void ls_square_next_inner(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, const LS_GLOBAL float* noise,
                                LS_GLOBAL float* out) {
  ls_square_quad(g, i, j, 1, 1, 1, 1, parent, noise, out);
}

/* Output posts: mean of the four cells around post (i, j). */
LS_FN void ls_square_mean(const ls_step* g, int i, int j, int has_w, int has_e, int has_n, int has_s,
                          const LS_GLOBAL float* cells, LS_GLOBAL float* out) {
  const int se = g->parent_at + j * g->parent_pitch + i, ne = se - g->parent_pitch;
  const float nw_v = has_w ? cells[ne - 1] : cells[ne], ne_v = has_e ? cells[ne] : cells[ne - 1];
  const float sw_v = has_w ? cells[se - 1] : cells[se], se_v = has_e ? cells[se] : cells[se - 1];
  const float n = (nw_v + ne_v) * 0.5f, s = (sw_v + se_v) * 0.5f;
  out[j * g->pitch + i] = ((has_n ? n : s) + (has_s ? s : n)) * 0.5f;
}

LS_FN void ls_square_post(const ls_step* g, int i, int j, const LS_GLOBAL float* cells, LS_GLOBAL float* out) {
  ls_square_mean(g, i, j, i > g->lo_i, i <= g->hi_i, j > g->lo_j, j <= g->hi_j, cells, out);
}

/* ls_square_post() where every cell exists. */
LS_FN void ls_square_post_inner(const ls_step* g, int i, int j, const LS_GLOBAL float* cells, LS_GLOBAL float* out) {
  ls_square_mean(g, i, j, 1, 1, 1, 1, cells, out);
}

/* ---- diamond-square ---- */

LS_FN void ls_diamond_centre(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, const LS_GLOBAL float* noise,
                             LS_GLOBAL float* centres) {
  const int n = g->parent_at + j * g->parent_pitch + i, s = n + g->parent_pitch;
  const int at = j * g->pitch + i;
  centres[at] = ((parent[n] + parent[n + 1]) + (parent[s] + parent[s + 1])) * 0.25f + noise[at];
}

LS_FN void ls_diamond_quad(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, const LS_GLOBAL float* centres,
                           const LS_GLOBAL float* horizontal, const LS_GLOBAL float* vertical, LS_GLOBAL float* out) {
  const int p = g->parent_at + j * g->parent_pitch + i, at = j * g->pitch + i;
  const float c = centres[at], cw = centres[at - 1], cn = centres[at - g->pitch];
  const float c_west = i > g->lo_i ? cw : c, c_east = i < g->hi_i ? c : cw;
  const float c_north = j > g->lo_j ? cn : c, c_south = j < g->hi_j ? c : cn;
  const int n = 2 * j * 2 * g->pitch + 2 * i, s = n + 2 * g->pitch;
  out[n] = parent[p];
  out[n + 1] = ((parent[p] + parent[p + 1]) + (c_north + c_south)) * 0.25f + horizontal[at];
  out[s] = ((parent[p] + parent[p + g->parent_pitch]) + (c_west + c_east)) * 0.25f + vertical[at];
  out[s + 1] = c;
}

/* ---- fractal wavelet ---- */

/* Number of the world's cells that touch post (i, j): 4, 2 on the border, 1 in a corner; 1 elsewhere (never used there). */
LS_FN int ls_cells_touching(const ls_step* g, int i, int j) {
  const int x = (i > g->lo_i && i <= g->hi_i) + (i >= g->lo_i && i < g->hi_i);
  const int y = (j > g->lo_j && j <= g->hi_j) + (j >= g->lo_j && j < g->hi_j);
  return x * y > 0 ? x * y : 1;
}

/* Share of a displacement that each of the four points around it gives up: V_new / (V_1 + V_2 + V_3 + V_4). */
LS_FN float ls_theta(const ls_step* g, int i, int j) {
  int top, bottom;
  if (!g->is_near_border) return g->is_published ? 0.0625f : 1.0f / 12.0f;
  if (g->band == 3) {
    const int odd = (g->parity + i + j) & 1; /* 0: north-west and south-east have the even sums */
    top = 2;
    bottom = (2 - odd) * (ls_cells_touching(g, i, j) + ls_cells_touching(g, i + 1, j + 1)) +
             (1 + odd) * (ls_cells_touching(g, i + 1, j) + ls_cells_touching(g, i, j + 1));
  } else {
    const int is_horizontal = g->band == 1;
    const int lo = is_horizontal ? g->lo_j : g->lo_i, hi = is_horizontal ? g->hi_j : g->hi_i, k = is_horizontal ? j : i;
    const int adjacent = (k > lo) + (k < hi);
    const int ends = ls_cells_touching(g, i, j) + ls_cells_touching(g, i + is_horizontal, j + 1 - is_horizontal);
    top = adjacent;
    bottom = 2 * ends + 4 * adjacent;
  }
  return g->is_published ? (float)(3 * top) / (float)(4 * bottom) : (float)top / (float)bottom;
}

LS_FN void ls_weight(const ls_step* g, int i, int j, const LS_GLOBAL float* dh, LS_GLOBAL float* weights) {
  const int at = j * g->pitch + i;
  weights[at] = ls_theta(g, i, j) * dh[at];
}

/* Altitude, cap, erosion, in this order. lowest: of the four neighbours. */
LS_FN float ls_ruled(const ls_step* g, float dh, float base, float lowest) {
  if (g->has_altitude) {
    float t = (base - g->altitude_z0) * g->altitude_scale;
    t = t < 0.0f ? 0.0f : (t > 1.0f ? 1.0f : t);
    dh = dh * (g->altitude_lo + g->altitude_span * t);
  }
  if (g->has_cap) dh = dh < -g->cap_m ? -g->cap_m : (dh > g->cap_m ? g->cap_m : dh);
  if (g->has_erosion && (!g->has_water || base > g->water_m)) {
    const float floor_dh = lowest - base;
    dh = dh < floor_dh ? floor_dh : dh;
  }
  return dh;
}

LS_FN float ls_lower(float a, float b) { return a < b ? a : b; }

LS_FN void ls_rule_centre(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, LS_GLOBAL float* dh) {
  const int n = g->parent_at + j * g->parent_pitch + i, s = n + g->parent_pitch, at = j * g->pitch + i;
  const float nw = parent[n], ne = parent[n + 1], sw = parent[s], se = parent[s + 1];
  const float base = ((g->parity + i + j) & 1) ? (ne + sw) * 0.5f : (nw + se) * 0.5f;
  dh[at] = ls_ruled(g, dh[at], base, ls_lower(ls_lower(nw, ne), ls_lower(sw, se)));
}

LS_FN void ls_half1_post(const ls_step* g, int i, int j, const LS_GLOBAL float* parent, const LS_GLOBAL float* w3,
                         LS_GLOBAL float* posts) {
  const int at = j * g->pitch + i, up = at - g->pitch;
  posts[at] = parent[g->parent_at + j * g->parent_pitch + i] - ((w3[up - 1] + w3[up]) + (w3[at - 1] + w3[at]));
}

LS_FN void ls_half1_centre(const ls_step* g, int i, int j, const LS_GLOBAL float* posts, const LS_GLOBAL float* dh3,
                           LS_GLOBAL float* centres) {
  const int at = j * g->pitch + i, down = at + g->pitch;
  const float falling = (posts[at] + posts[down + 1]) * 0.5f, rising = (posts[at + 1] + posts[down]) * 0.5f;
  centres[at] = (((g->parity + i + j) & 1) ? rising : falling) + dh3[at];
}

LS_FN void ls_rule_edge(const ls_step* g, int i, int j, const LS_GLOBAL float* posts, const LS_GLOBAL float* centres,
                        LS_GLOBAL float* dh) {
  const int at = j * g->pitch + i, is_horizontal = g->band == 1;
  const int step = is_horizontal ? 1 : g->pitch, side = is_horizontal ? g->pitch : 1;
  const int k = is_horizontal ? j : i, lo = is_horizontal ? g->lo_j : g->lo_i, hi = is_horizontal ? g->hi_j : g->hi_i;
  const float a = posts[at], b = posts[at + step], c0 = centres[at - side], c1 = centres[at];
  float lowest = ls_lower(a, b);
  if (k > lo) lowest = ls_lower(lowest, c0);
  if (k < hi) lowest = ls_lower(lowest, c1);
  dh[at] = ls_ruled(g, dh[at], (a + b) * 0.5f, lowest);
}

/* Old posts and centres after half-step 2. */
LS_FN void ls_half2_old(const ls_step* g, int i, int j, const LS_GLOBAL float* posts, const LS_GLOBAL float* centres,
                        const LS_GLOBAL float* w1, const LS_GLOBAL float* w2, LS_GLOBAL float* posts2,
                        LS_GLOBAL float* centres2) {
  const int at = j * g->pitch + i, up = at - g->pitch, down = at + g->pitch;
  posts2[at] = posts[at] - ((w1[at - 1] + w1[at]) + (w2[up] + w2[at]));
  centres2[at] = centres[at] - ((w1[at] + w1[down]) + (w2[at] + w2[at + 1]));
}

LS_FN void ls_half2_quad(const ls_step* g, int i, int j, const LS_GLOBAL float* posts2, const LS_GLOBAL float* centres2,
                         const LS_GLOBAL float* dh1, const LS_GLOBAL float* dh2, LS_GLOBAL float* out) {
  const int at = j * g->pitch + i;
  const int n = 2 * j * 2 * g->pitch + 2 * i, s = n + 2 * g->pitch;
  out[n] = posts2[at];
  out[n + 1] = (posts2[at] + posts2[at + 1]) * 0.5f + dh1[at];
  out[s] = (posts2[at] + posts2[at + g->pitch]) * 0.5f + dh2[at];
  out[s + 1] = centres2[at];
}

#endif
