/* Counter-based random numbers: Philox4x32-10 and a Gaussian made of integer sums and + - * only, so that every compiler and
   device gives the same bits. Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3"; SPEC-SYNTHESIS section 1.
   A value depends on the seed (key) and on what it is for (counter), never on the order of evaluation. */
#ifndef LS_RANDOM_H
#define LS_RANDOM_H

#include "kernels/shared/ls_platform.h"

#define LS_ALGO_WAVELET 1u
#define LS_ALGO_SQUARE_SQUARE 2u
#define LS_ALGO_DIAMOND_SQUARE 3u
#define LS_ALGO_OSTROWSKI 4u
#define LS_ALGO_FLORA 5u

#define LS_PHILOX_M0 0xD2511F53u
#define LS_PHILOX_M1 0xCD9E8D57u
#define LS_PHILOX_W0 0x9E3779B9u
#define LS_PHILOX_W1 0xBB67AE85u

/* Largest possible |ls_gaussian()|: the value of all-one words. */
#define LS_GAUSSIAN_MAX 6.56819153f

/* Polynomial of the Gaussian, bits 4099c70f 3f3808a7 3dcbf5d8 3f71c337. */
#define LS_GAUSSIAN_A 4.805549f
#define LS_GAUSSIAN_B 0.718882f
#define LS_GAUSSIAN_C 0.09959f
#define LS_GAUSSIAN_D 0.944385f
#define LS_GAUSSIAN_SCALE (1.0f / 262144.0f)

typedef struct {
  ls_uint w0, w1, w2, w3;
} ls_words;

/* Third counter word: level of the coefficient, band 0..3, one of LS_ALGO_, image channel. */
LS_FN ls_uint ls_stream(ls_uint level, ls_uint band, ls_uint algo, ls_uint channel) {
  return level | (band << 8) | (algo << 16) | (channel << 24);
}

#define LS_PHILOX_ROUND                                  \
  {                                                      \
    const ls_ulong p0 = (ls_ulong)LS_PHILOX_M0 * c0;     \
    const ls_ulong p1 = (ls_ulong)LS_PHILOX_M1 * c2;     \
    c0 = (ls_uint)(p1 >> 32) ^ c1 ^ k0;                  \
    c2 = (ls_uint)(p0 >> 32) ^ c3 ^ k1;                  \
    c1 = (ls_uint)p1;                                    \
    c3 = (ls_uint)p0;                                    \
    k0 += LS_PHILOX_W0;                                  \
    k1 += LS_PHILOX_W1;                                  \
  }

LS_FN ls_words ls_philox(ls_uint c0, ls_uint c1, ls_uint c2, ls_uint c3, ls_uint k0, ls_uint k1) {
  ls_words out;
  LS_PHILOX_ROUND LS_PHILOX_ROUND LS_PHILOX_ROUND LS_PHILOX_ROUND LS_PHILOX_ROUND
  LS_PHILOX_ROUND LS_PHILOX_ROUND LS_PHILOX_ROUND LS_PHILOX_ROUND LS_PHILOX_ROUND
  out.w0 = c0;
  out.w1 = c1;
  out.w2 = c2;
  out.w3 = c3;
  return out;
}

/* Mean 0, variance 1 + 1e-7, |g| <= LS_GAUSSIAN_MAX. */
LS_FN float ls_gaussian_from_words(ls_words w) {
  const ls_uint sum = (w.w0 & 0xffffu) + (w.w0 >> 16) + (w.w1 & 0xffffu) + (w.w1 >> 16) + (w.w2 & 0xffffu) + (w.w2 >> 16) +
                      (w.w3 & 0xffffu) + (w.w3 >> 16);
  const float r = (float)((int)sum - 262140) * LS_GAUSSIAN_SCALE;
  const float r2 = r * r;
  return r * (LS_GAUSSIAN_A + r2 * (LS_GAUSSIAN_B + r2 * (LS_GAUSSIAN_C + r2 * LS_GAUSSIAN_D)));
}

/* The Gaussian of index (i, j) of one stream; k0, k1: low and high word of the seed. */
LS_FN float ls_gaussian(ls_uint i, ls_uint j, ls_uint stream, ls_uint k0, ls_uint k1) {
  return ls_gaussian_from_words(ls_philox(i, j, stream, 0u, k0, k1));
}

#ifdef LS_LOCAL_SIZE /* OpenCL: sixteen at once */

/* The state lives in 64-bit lanes whose upper halves hold leftovers: a product masks its operand, so nothing has to be packed
   between rounds. Even and odd columns are separate vectors, because that is how the halves of a 64-bit lane lie in memory. */
#define LS_LOW32 0xfffffffful
#define LS_ROUND16(c0, c1, c2, c3)                          \
  {                                                         \
    const ulong8 p0 = (c0 & LS_LOW32) * (ulong)LS_PHILOX_M0; \
    const ulong8 p1 = (c2 & LS_LOW32) * (ulong)LS_PHILOX_M1; \
    c0 = (p1 >> 32) ^ c1 ^ (ulong)k0;                       \
    c2 = (p0 >> 32) ^ c3 ^ (ulong)k1;                       \
    c1 = p1;                                                \
    c3 = p0;                                                \
  }
#define LS_ROUNDS16                        \
  LS_ROUND16(e0, e1, e2, e3)               \
  LS_ROUND16(o0, o1, o2, o3)               \
  k0 += LS_PHILOX_W0;                      \
  k1 += LS_PHILOX_W1;
#define LS_JOIN16(e, o) as_uint16((o << 32) | (e & LS_LOW32))

/* ls_gaussian() of sixteen indices. */
LS_FN float16 ls_gaussian16(uint16 i, uint16 j, uint stream, uint k0, uint k1) {
  ulong8 e0 = as_ulong8(i), o0 = e0 >> 32, e1 = as_ulong8(j), o1 = e1 >> 32;
  ulong8 e2 = (ulong8)(stream), o2 = e2, e3 = (ulong8)(0), o3 = e3;
  LS_ROUNDS16 LS_ROUNDS16 LS_ROUNDS16 LS_ROUNDS16 LS_ROUNDS16
  LS_ROUNDS16 LS_ROUNDS16 LS_ROUNDS16 LS_ROUNDS16 LS_ROUNDS16
  const uint16 w0 = LS_JOIN16(e0, o0), w1 = LS_JOIN16(e1, o1), w2 = LS_JOIN16(e2, o2), w3 = LS_JOIN16(e3, o3);
  const uint16 low = ((w0 & 0xffffu) + (w1 & 0xffffu)) + ((w2 & 0xffffu) + (w3 & 0xffffu));
  const uint16 high = ((w0 >> 16) + (w1 >> 16)) + ((w2 >> 16) + (w3 >> 16));
  const float16 r = convert_float16(as_int16(low + high) - 262140) * LS_GAUSSIAN_SCALE;
  const float16 r2 = r * r;
  return r * (LS_GAUSSIAN_A + r2 * (LS_GAUSSIAN_B + r2 * (LS_GAUSSIAN_C + r2 * LS_GAUSSIAN_D)));
}
#endif

#endif
