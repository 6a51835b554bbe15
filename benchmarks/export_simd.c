/* Hand-written SIMD for a Gaussian process (SE-ARD, own length-scales per output), the yardstick of export_speed.py.
   Compiled once per register width (-DWIDTH=512 or 256). Data come in as arrays padded to 8 points:
   support[D][P], inverse[O][D] = 1/l^2, weights[O][P], and for the variance one of
     first, second [O][P][P] column-major, the two triangular factors (variant a),
     blocks[O][...] the merged factor in blocks of eight rows (variant b; see mpc_export/c_kernels_common.py),
     full[O][P][P] the symmetric matrix of the quadratic form (variant c).
   Results: mean[O], jac[O][D], variance[O], vjac[O][D]. Unit variance, unit scales. */
#include <immintrin.h>

#if WIDTH == 512
typedef __m512d V;
#define L 8
#define LOAD _mm512_loadu_pd
#define STORE _mm512_storeu_pd
#define SET _mm512_set1_pd
#define FMA _mm512_fmadd_pd
#define MUL _mm512_mul_pd
#define ADD _mm512_add_pd
#define SUB _mm512_sub_pd
#define SUM _mm512_reduce_add_pd
static inline V scale(V y, V n) { return _mm512_scalef_pd(y, n); }
static inline V nearest(V x) { return _mm512_roundscale_pd(x, 8); }
#else
typedef __m256d V;
#define L 4
#define LOAD _mm256_loadu_pd
#define STORE _mm256_storeu_pd
#define SET _mm256_set1_pd
#define FMA _mm256_fmadd_pd
#define MUL _mm256_mul_pd
#define ADD _mm256_add_pd
#define SUB _mm256_sub_pd
static inline double SUM(V a) {
  __m128d s = _mm_add_pd(_mm256_castpd256_pd128(a), _mm256_extractf128_pd(a, 1));
  return _mm_cvtsd_f64(_mm_add_sd(s, _mm_unpackhi_pd(s, s)));
}
static inline V scale(V y, V n) {
  const V shifted = _mm256_add_pd(n, _mm256_set1_pd(6755399441055744.0 + 1023.0));
  return _mm256_mul_pd(y, _mm256_castsi256_pd(_mm256_slli_epi64(_mm256_castpd_si256(shifted), 52)));
}
static inline V nearest(V x) { return _mm256_round_pd(x, 8); }
#endif

static inline V vexp(V x) {
  V n, r, y;
#if WIDTH == 512
  x = _mm512_max_pd(x, SET(-745.0));
#else
  x = _mm256_max_pd(x, SET(-708.0));
#endif
  n = nearest(MUL(x, SET(1.4426950408889634)));
  r = FMA(n, SET(-6.93147180369123816490e-01), x);
  r = FMA(n, SET(-1.90821492927058770002e-10), r);
  y = SET(2.510038549551032e-08);
  y = FMA(y, r, SET(2.7620088445409746e-07));
  y = FMA(y, r, SET(2.7557268459997064e-06));
  y = FMA(y, r, SET(2.4801521295954376e-05));
  y = FMA(y, r, SET(0.00019841269863053618));
  y = FMA(y, r, SET(0.0013888888917213717));
  y = FMA(y, r, SET(0.008333333333330062));
  y = FMA(y, r, SET(0.04166666666662413));
  y = FMA(y, r, SET(0.16666666666666669));
  y = FMA(y, r, SET(0.5000000000000001));
  y = FMA(y, r, SET(1.0));
  y = FMA(y, r, SET(1.0));
  return scale(y, n);
}

/* k of one output, the expanded square: base[P] = sum_d b^2/l^2, times -1/2; scaled[D][P] = b/l^2. */
static inline void covariance_expanded(const double* x, const double* base, const double* scaled, const double* inv, double* k) {
  double own = 0;
  int d, i;
  for (d = 0; d < D; ++d) own += x[d]*x[d]*inv[d];
  for (i = 0; i < P; i += L) {
    V s = FMA(SET(-0.5), SET(own), LOAD(base + i));
#pragma GCC unroll 16
    for (d = 0; d < D; ++d) s = FMA(SET(x[d]), LOAD(scaled + d*P + i), s);
    STORE(k + i, vexp(s));
  }
}

/* k of all outputs from differences that they share. */
static inline void covariance_joint(const double* x, const double* support, const double* inverse, double* k) {
  int d, i, o;
  for (i = 0; i < P; i += L) {
    V s[O];
#pragma GCC unroll 16
    for (o = 0; o < O; ++o) s[o] = SET(0.0);
#pragma GCC unroll 16
    for (d = 0; d < D; ++d) {
      V t = SUB(SET(x[d]), LOAD(support + d*P + i));
      t = MUL(t, t);
#pragma GCC unroll 16
      for (o = 0; o < O; ++o) s[o] = FMA(t, SET(inverse[o*D + d]), s[o]);
    }
#pragma GCC unroll 16
    for (o = 0; o < O; ++o) STORE(k + o*P + i, vexp(MUL(s[o], SET(-0.5))));
  }
}

/* sum c k (b_d - x_d)/l_d^2, points across lanes. */
static inline double contract(const double* x, const double* support, const double* inv, const double* c, const double* k,
    double factor, double* out) {
  V a[D], all = SET(0.0);
  double total;
  int d, i;
#pragma GCC unroll 16
  for (d = 0; d < D; ++d) a[d] = SET(0.0);
  for (i = 0; i < P; i += L) {
    const V t = MUL(LOAD(c + i), LOAD(k + i));
    all = ADD(all, t);
#pragma GCC unroll 16
    for (d = 0; d < D; ++d) a[d] = FMA(t, LOAD(support + d*P + i), a[d]);
  }
  total = SUM(all);
  for (d = 0; d < D; ++d) out[d] = factor*inv[d]*(SUM(a[d]) - x[d]*total);
  return total;
}

/* The same with inputs across lanes: rows[P][16] holds b and a one in place D, so that nothing is summed over lanes. */
static inline double contract_rows(const double* x, const double* rows, const double* inv, const double* c, const double* k,
    double factor, double* out) {
  V a[16/L], b[16/L];
  double r[16];
  int d, i;
#pragma GCC unroll 16
  for (d = 0; d < 16/L; ++d) a[d] = b[d] = SET(0.0);
  for (i = 0; i < P; i += 2) {
    const V t = SET(c[i]*k[i]), u = SET(c[i + 1]*k[i + 1]);
#pragma GCC unroll 16
    for (d = 0; d < (D + L)/L; ++d) {
      a[d] = FMA(t, LOAD(rows + i*16 + d*L), a[d]);
      b[d] = FMA(u, LOAD(rows + i*16 + 16 + d*L), b[d]);
    }
  }
#pragma GCC unroll 16
  for (d = 0; d < 16/L; ++d) STORE(r + d*L, ADD(a[d], b[d]));
  for (d = 0; d < D; ++d) out[d] = factor*inv[d]*(r[d] - x[d]*r[D]);
  return r[D];
}

/* |F k|^2 and v += sign F'F k for a column-major lower triangle. */
static inline double two_passes(const double* f, const double* k, double sign, double* v) {
  double e[P];
  V s = SET(0.0);
  int c, i;
  for (i = 0; i < P; i += L) STORE(e + i, SET(0.0));
  for (c = 0; c < P; ++c) {
    const V t = SET(k[c]);
    for (i = c/L*L; i < P; i += L) STORE(e + i, FMA(t, LOAD(f + c*P + i), LOAD(e + i)));
  }
  for (i = 0; i < P; i += L) s = FMA(LOAD(e + i), LOAD(e + i), s);
  for (c = 0; c < P; ++c) {
    V t = SET(0.0);
    for (i = c/L*L; i < P; i += L) t = FMA(LOAD(f + c*P + i), LOAD(e + i), t);
    v[c] += sign*SUM(t);
  }
  return SUM(s);
}

/* |E k|^2 and v = E'E k in one pass over blocks of eight rows; negated. */
static inline double one_pass(const double* e, const double* k, double* v) {
  double total = 0;
  int g, c, r;
  for (g = 0; g < P; g += 8) {
    V a[8];
    double s[8];
    const int m = g + 8;
#pragma GCC unroll 8
    for (r = 0; r < 8; ++r) a[r] = SET(0.0);
    for (c = 0; c < m; c += L) {
      const V t = LOAD(k + c);
#pragma GCC unroll 8
      for (r = 0; r < 8; ++r) a[r] = FMA(t, LOAD(e + r*m + c), a[r]);
    }
#pragma GCC unroll 8
    for (r = 0; r < 8; ++r) { s[r] = SUM(a[r]); total += s[r]*s[r]; }
    for (c = 0; c < m; c += L) {
      V t = c < g ? LOAD(v + c) : SET(0.0), u = SET(0.0);
#pragma GCC unroll 8
      for (r = 0; r < 8; r += 2) {
        t = FMA(SET(-s[r]), LOAD(e + r*m + c), t);
        u = FMA(SET(-s[r + 1]), LOAD(e + (r + 1)*m + c), u);
      }
      STORE(v + c, ADD(t, u));
    }
    e += 8*m;
  }
  return total;
}

/* k'Qk and v = -Qk for a full symmetric matrix, column by column into registers. */
static inline double quadratic(const double* q, const double* k, double* v) {
  V s = SET(0.0);
  int c, i, j;
  for (i = 0; i < P; i += 4*L) {
    V a[4];
    const int n = (P - i)/L < 4 ? (P - i)/L : 4;
    if (n == 4) {
#pragma GCC unroll 4
      for (j = 0; j < 4; ++j) a[j] = SET(0.0);
      for (c = 0; c < M; ++c) {
        const V t = SET(k[c]);
#pragma GCC unroll 4
        for (j = 0; j < 4; ++j) a[j] = FMA(t, LOAD(q + c*P + i + j*L), a[j]);
      }
#pragma GCC unroll 4
      for (j = 0; j < 4; ++j) { s = FMA(a[j], LOAD(k + i + j*L), s); STORE(v + i + j*L, SUB(SET(0.0), a[j])); }
    } else {
      for (j = 0; j < n; ++j) {
        V b = SET(0.0);
        for (c = 0; c < M; ++c) b = FMA(SET(k[c]), LOAD(q + c*P + i + j*L), b);
        s = FMA(b, LOAD(k + i + j*L), s);
        STORE(v + i + j*L, SUB(SET(0.0), b));
      }
    }
  }
  return SUM(s);
}

typedef struct {
  const double *support, *rows, *base, *scaled, *inverse, *weights, *first, *second, *blocks, *full;
} Data;
#define BLOCKS (32*(P/8)*(P/8 + 1))

/* a: one output after the other, expanded square, points across lanes; two factors, each passed twice. */
int simd_a(const Data* g, const double* x, double* mean, double* jac, double* variance, double* vjac) {
  double k[P], v[P];
  int o, i;
  for (o = 0; o < O; ++o) {
    covariance_expanded(x, g->base + o*P, g->scaled + o*D*P, g->inverse + o*D, k);
    mean[o] = contract(x, g->support, g->inverse + o*D, g->weights + o*P, k, 1.0, jac + o*D);
    if (variance) {
      for (i = 0; i < P; ++i) v[i] = 0;
      variance[o] = 1.0 - two_passes(g->first + o*P*P, k, -1.0, v);
      variance[o] += two_passes(g->second + o*P*P, k, 1.0, v);
      contract(x, g->support, g->inverse + o*D, v, k, 2.0, vjac + o*D);
    }
  }
  return 0;
}

/* b: all outputs at once, differences; the merged factor in one pass. */
int simd_b(const Data* g, const double* x, double* mean, double* jac, double* variance, double* vjac) {
  double k[O*P], v[P];
  int o;
  covariance_joint(x, g->support, g->inverse, k);
  for (o = 0; o < O; ++o) {
    mean[o] = contract(x, g->support, g->inverse + o*D, g->weights + o*P, k + o*P, 1.0, jac + o*D);
    if (variance) {
      variance[o] = 1.0 - one_pass(g->blocks + o*BLOCKS, k + o*P, v);
      contract(x, g->support, g->inverse + o*D, v, k + o*P, 2.0, vjac + o*D);
    }
  }
  return 0;
}

/* c: all outputs at once, inputs across lanes in the contraction; the quadratic form with a full matrix. */
int simd_c(const Data* g, const double* x, double* mean, double* jac, double* variance, double* vjac) {
  double k[O*P], v[P];
  int o;
  covariance_joint(x, g->support, g->inverse, k);
  for (o = 0; o < O; ++o) {
    mean[o] = contract_rows(x, g->rows, g->inverse + o*D, g->weights + o*P, k + o*P, 1.0, jac + o*D);
    if (variance) {
      variance[o] = 1.0 - quadratic(g->full + o*P*P, k + o*P, v);
      contract_rows(x, g->rows, g->inverse + o*D, v, k + o*P, 2.0, vjac + o*D);
    }
  }
  return 0;
}
