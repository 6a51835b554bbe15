/* Extended Kalman filter over one record, around a generated linearisation of one step.

   gb_ekf_lin(x, U, y, p, dt) -> xF, e, A, E, G, F   (A = dx+/dx, E = de/dx, G = dx+/dw, F = de/dw; dense, by columns)
   gb_ekf_move(xF, k)         -> x+ = xF boxplus k

   One-step predictor with process noise w ~ (0, diag q) that enters state and output alike:
     S = E P E' + F Q F' + R,   N = -(A P E' + G Q F'),   P+ = A P A' + G Q G' - N S^-1 N',   x+ = xF boxplus N S^-1 e
   S = L D L' with unit lower triangular L; the outputs are the decorrelated innovations L^-1 e and their variances D. */

#include <string.h>

#define REAL double
typedef long long INT;

extern int gb_ekf_lin(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_ekf_lin_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);
extern int gb_ekf_move(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_ekf_move_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);

void gb_ekf_sizes(INT *args, INT *ress, INT *iws, INT *ws) {
  INT a[2], r[2], i[2], w[2];
  gb_ekf_lin_work(a, r, i, w);
  gb_ekf_move_work(a + 1, r + 1, i + 1, w + 1);
  *args = 8 + (a[0] > a[1] ? a[0] : a[1]);
  *ress = 8 + (r[0] > r[1] ? r[0] : r[1]);
  *iws = 8 + (i[0] > i[1] ? i[0] : i[1]);
  *ws = 8 + (w[0] > w[1] ? w[0] : w[1]);
}

INT gb_ekf_buffer(int nx, int nd, int ne, int nw) {
  return 3 * nx + ne + nd + 2 * nd * nd + 3 * nd * ne + (INT)nd * nw + 2 * (INT)ne * nw + ne * ne + 64;
}

/* out (m x n) = a (m x k) * b (k x n), by columns; add: onto what is there */
static void product(int m, int k, int n, const REAL *a, const REAL *b, REAL *out, int add) {
  if (!add) memset(out, 0, (size_t)m * n * sizeof(REAL));
  for (int j = 0; j < n; ++j) {
    REAL *restrict dst = out + (size_t)j * m;
    for (int l = 0; l < k; ++l) {
      const REAL f = b[(size_t)j * k + l];
      const REAL *restrict src = a + (size_t)l * m;
      if (f == 0) continue;
      for (int i = 0; i < m; ++i) dst[i] += f * src[i];
    }
  }
}

/* out (m x n) += sign * a (m x k) diag(q) b' (n x k)', by columns; q NULL: ones */
static void product_t(int m, int k, int n, const REAL *a, const REAL *q, const REAL *b, REAL *out, REAL sign) {
  for (int l = 0; l < k; ++l) {
    const REAL *restrict src = a + (size_t)l * m;
    for (int j = 0; j < n; ++j) {
      const REAL f = sign * (q ? q[l] : 1) * b[(size_t)l * n + j];
      REAL *restrict dst = out + (size_t)j * m;
      if (f == 0) continue;
      for (int i = 0; i < m; ++i) dst[i] += f * src[i];
    }
  }
}

/* x (nx) and P (nd x nd) in/out; U, Y, M as in gb_run; q (nw), r (ne) variances; Eout, Vout (n x ne).
   Returns 0, or 1 + k where sample k has no finite numbers or no positive variance. */
int gb_ekf(int n, int nx, int nd, int ne, int ny, int nu, int nw, REAL *x, REAL *P, const REAL *U, const REAL *Y,
           const REAL *M, const REAL *p, REAL dt, const REAL *q, const REAL *r, REAL *Eout, REAL *Vout,
           const REAL **arg, REAL **res, INT *iw, REAL *w, REAL *buf) {
  REAL *xF = buf, *xn = xF + nx, *e = xn + nx, *k = e + ne, *A = k + nd, *AP = A + nd * nd, *E = AP + nd * nd,
       *G = E + ne * nd, *F = G + nd * nw, *PE = F + ne * nw, *N = PE + nd * ne, *S = N + nd * ne;
  for (int t = 0; t < n; ++t) {
    const REAL *m = M + (size_t)t * ne;
    REAL *v = Vout + (size_t)t * ne, *z = Eout + (size_t)t * ne;
    arg[0] = x;
    arg[1] = U + (size_t)t * nu;
    arg[2] = Y + (size_t)t * ny;
    arg[3] = p;
    arg[4] = &dt;
    res[0] = xF; res[1] = e; res[2] = A; res[3] = E; res[4] = G; res[5] = F;
    if (gb_ekf_lin(arg, res, iw, w, 0)) return 1 + t;
    for (int i = 0; i < ne; ++i)
      if (m[i] == 0) {
        e[i] = 0;
        for (int j = 0; j < nd; ++j) E[i + j * ne] = 0;
        for (int j = 0; j < nw; ++j) F[i + j * ne] = 0;
      }
    memset(PE, 0, (size_t)nd * ne * sizeof(REAL));
    product_t(nd, nd, ne, P, 0, E, PE, 1);
    product(nd, nd, nd, A, P, AP, 0);
    memset(N, 0, (size_t)nd * ne * sizeof(REAL));
    product_t(nd, nd, ne, AP, 0, E, N, -1);
    product_t(nd, nw, ne, G, q, F, N, -1);
    product(ne, nd, ne, E, PE, S, 0);
    product_t(ne, nw, ne, F, q, F, S, 1);
    for (int i = 0; i < ne; ++i) S[i + i * ne] += m[i] == 0 ? 1 : r[i];
    memset(P, 0, (size_t)nd * nd * sizeof(REAL));
    product_t(nd, nd, nd, AP, 0, A, P, 1);
    product_t(nd, nw, nd, G, q, G, P, 1);
    memset(k, 0, nd * sizeof(REAL));
    /* One scalar measurement after the other: column i of N and S is cleared of what the earlier ones have explained. */
    for (int i = 0; i < ne; ++i) {
      const REAL d = S[i + i * ne];
      REAL *restrict Ni = N + (size_t)i * nd;
      if (!(d > 0)) return 1 + t;
      v[i] = d;
      z[i] = e[i];
      for (int l = i + 1; l < ne; ++l) {
        const REAL f = S[l + i * ne] / d;
        if (f == 0) continue;
        REAL *restrict Nl = N + (size_t)l * nd;
        e[l] -= f * e[i];
        for (int a = 0; a < nd; ++a) Nl[a] -= f * Ni[a];
        for (int b = i + 1; b < ne; ++b) S[l + b * ne] -= f * S[b + i * ne];
      }
      for (int a = 0; a < nd; ++a) k[a] += Ni[a] * (e[i] / d);
      for (int b = 0; b < nd; ++b) {
        const REAL f = Ni[b] / d;
        REAL *restrict Pb = P + (size_t)b * nd;
        if (f == 0) continue;
        for (int a = 0; a < nd; ++a) Pb[a] -= f * Ni[a];
      }
    }
    for (int b = 0; b < nd; ++b)
      for (int a = 0; a < b; ++a) P[a + b * nd] = P[b + a * nd] = 0.5 * (P[a + b * nd] + P[b + a * nd]);
    arg[0] = xF; arg[1] = k;
    res[0] = xn;
    if (gb_ekf_move(arg, res, iw, w, 0)) return 1 + t;
    memcpy(x, xn, nx * sizeof(REAL));
    for (int i = 0; i < nx; ++i)
      if (!(x[i] - x[i] == 0)) return 1 + t;
  }
  return 0;
}
