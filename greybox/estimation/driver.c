/* Filter and sensitivity recursion over one record, around a generated linearisation of one step.

   gb_value(x, U, y, p, dt) -> xF, e, yhat    (prediction, innovation)
   gb_slope(x, U, y, p, dt) -> A, B, E, H     (dxF/dx, dxF/dp, de/dx, de/dp), LANES samples at a time
   gb_pred(x, U, p, dt)     -> xF, yhat
   gb_move(xF, k)           -> x+             (x+ = xF boxplus k)
   gb_turn(xF, k)           -> J1, J2         (dx+/dxF, dx+/dk), LANES samples at a time

   S (nd x ns, row-major) is the derivative of the error state with respect to the local parameters:
     dE = E S + H,   S+ = J1 (A S + B) + J2 (K dE + dK e)
   Columns of S: first the na active model parameters, then others (noise levels through dK, initial error states).
   The states of LANES samples come first, one after the other, then their slopes side by side, then S. */

#include <string.h>

#define REAL double
typedef long long INT;

extern int gb_value(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_value_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);
extern int gb_slope(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern const INT *gb_slope_sparsity_out(INT i);
extern int gb_pred(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_pred_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);
extern int gb_move(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_move_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);
extern int gb_turn(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern const INT *gb_turn_sparsity_out(INT i);

/* A sparsity is {rows, columns, column starts, rows of the entries}, or {rows, columns, 1} where it is dense. */
static int is_dense(const INT *sp) { return sp[2] == 1; }

static INT entries(const INT *sp) { return is_dense(sp) ? sp[0] * sp[1] : sp[2 + sp[1]]; }

/* out (rows x n) += M (compressed columns, one lane of it) * in (cols x n) */
static void sparse_dense(const INT *sp, const REAL *m, const REAL *in, REAL *out, int n) {
  const INT nrow = sp[0], ncol = sp[1];
  const INT *colind = sp + 2, *row = sp + 3 + ncol;
  const int dense = is_dense(sp);
  for (INT c = 0; c < ncol; ++c) {
    const REAL *restrict src = in + c * n;
    const INT from = dense ? c * nrow : colind[c], to = dense ? from + nrow : colind[c + 1];
    for (INT k = from; k < to; ++k) {
      const REAL a = m[k * LANES];
      REAL *restrict dst = out + (dense ? k - from : row[k]) * n;
      for (int j = 0; j < n; ++j) dst[j] += a * src[j];
    }
  }
}

/* out (rows x n), first columns += M (compressed columns, one lane of it) scattered */
static void scatter(const INT *sp, const REAL *m, REAL *out, int n) {
  const INT nrow = sp[0], ncol = sp[1];
  const INT *colind = sp + 2, *row = sp + 3 + ncol;
  const int dense = is_dense(sp);
  for (INT c = 0; c < ncol; ++c) {
    const INT from = dense ? c * nrow : colind[c], to = dense ? from + nrow : colind[c + 1];
    for (INT k = from; k < to; ++k) out[(dense ? k - from : row[k]) * n + c] += m[k * LANES];
  }
}

/* Sizes that the caller needs: number of pointers, integers and reals of work memory. */
void gb_sizes(INT *args, INT *ress, INT *iws, INT *ws) {
  INT a[3], r[3], i[3], w[3];
  gb_value_work(a, r, i, w);
  gb_move_work(a + 1, r + 1, i + 1, w + 1);
  gb_pred_work(a + 2, r + 2, i + 2, w + 2);
  *args = *ress = *iws = *ws = 0;
  for (int k = 0; k < 3; ++k) {
    if (a[k] > *args) *args = a[k];
    if (r[k] > *ress) *ress = r[k];
    if (i[k] > *iws) *iws = i[k];
    if (w[k] > *ws) *ws = w[k];
  }
  *args += 8;
  *ress += 8;
  *iws += 8;
  *ws += 8;
}

/* Run n samples. Arrays are row-major, time first.
   x (nx) in/out, S (nd*ns) in/out (NULL: no sensitivities); U ((n + past + future) x nu) with the record's first sample
   at row `past`; Y (n x ny, missing = any number); M (n x ne, 1 = there, 0 = missing); pat (n) index of the gain;
   K (npat x nd x ne), zero_gain (npat): 1 = no correction; dK (npat x nd x ne x ns, NULL: gain is constant);
   Xout (n x nx), Eout (n x ne), Yout (n x ny), Jout (n x ne x ns): any may be NULL; Sout (n x nd x ns) likewise.
   Returns 0, or 1 + k when the numbers stop being finite at sample k. */
int gb_run(int n, int nx, int nd, int ne, int ny, int nu, int ns, REAL *x, REAL *S, const REAL *U, const REAL *Y,
           const REAL *M, const int *pat, const REAL *p, REAL dt, const REAL *K, const int *zero_gain, const REAL *dK,
           REAL *Xout, REAL *Eout, REAL *Yout, REAL *Jout, REAL *Sout, const REAL **arg, REAL **res, INT *iw, REAL *w,
           REAL *buf) {
  const INT *spA = gb_slope_sparsity_out(0), *spB = gb_slope_sparsity_out(1), *spE = gb_slope_sparsity_out(2),
            *spH = gb_slope_sparsity_out(3), *sp1 = gb_turn_sparsity_out(0), *sp2 = gb_turn_sparsity_out(1);
  REAL *X = buf, *XF = X + LANES * nx, *Es = XF + LANES * nx, *Ks = Es + LANES * ne, *yh = Ks + LANES * nd,
       *A = yh + ny, *B = A + LANES * entries(spA), *E = B + LANES * entries(spB), *H = E + LANES * entries(spE),
       *J1 = H + LANES * entries(spH), *J2 = J1 + LANES * entries(sp1), *dE = J2 + LANES * entries(sp2),
       *T = dE + ne * ns, *T2 = T + nd * ns, *Sn = T2 + nd * ns;
  const REAL *many[5 * LANES];
  REAL *out[4];
  for (int t0 = 0; t0 < n; t0 += LANES) {
    const int there = n - t0 < LANES ? n - t0 : LANES;
    int corrected = 0;
    for (int l = 0; l < there; ++l) {
      const int t = t0 + l, g = pat[t];
      const REAL *m = M + (size_t)t * ne;
      REAL *xF = XF + l * nx, *e = Es + l * ne, *k = Ks + l * nd;
      memcpy(X + l * nx, x, nx * sizeof(REAL));
      arg[0] = x;
      arg[1] = U + (size_t)t * nu;
      arg[2] = Y + (size_t)t * ny;
      arg[3] = p;
      arg[4] = &dt;
      res[0] = xF; res[1] = e; res[2] = yh;
      if (gb_value(arg, res, iw, w, 0)) return 1 + t;
      for (int i = 0; i < ne; ++i) e[i] = m[i] != 0 ? e[i] : 0;
      if (Xout) memcpy(Xout + (size_t)t * nx, x, nx * sizeof(REAL));
      if (Yout) memcpy(Yout + (size_t)t * ny, yh, ny * sizeof(REAL));
      if (Eout) memcpy(Eout + (size_t)t * ne, e, ne * sizeof(REAL));
      if (zero_gain[g]) {
        memset(k, 0, nd * sizeof(REAL));
        memcpy(x, xF, nx * sizeof(REAL));
      } else {
        const REAL *Kg = K + (size_t)g * nd * ne;
        for (int i = 0; i < nd; ++i) {
          REAL s = 0;
          for (int j = 0; j < ne; ++j) s += Kg[i * ne + j] * e[j];
          k[i] = s;
        }
        arg[0] = xF; arg[1] = k;
        res[0] = x;
        if (gb_move(arg, res, iw, w, 0)) return 1 + t;
        corrected = 1;
      }
      for (int i = 0; i < nx; ++i)
        if (!(x[i] - x[i] == 0)) return 1 + t;
    }
    if (!S) continue;
    for (int l = 0; l < LANES; ++l) {
      const int s = l < there ? l : there - 1;
      many[l] = X + s * nx;
      many[LANES + l] = U + (size_t)(t0 + s) * nu;
      many[2 * LANES + l] = Y + (size_t)(t0 + s) * ny;
      many[3 * LANES + l] = p;
      many[4 * LANES + l] = &dt;
    }
    out[0] = A; out[1] = B; out[2] = E; out[3] = H;
    if (gb_slope(many, out, 0, 0, 0)) return 1 + t0;
    if (corrected) {
      for (int l = 0; l < LANES; ++l) {
        const int s = l < there ? l : there - 1;
        many[l] = XF + s * nx;
        many[LANES + l] = Ks + s * nd;
      }
      out[0] = J1; out[1] = J2;
      if (gb_turn(many, out, 0, 0, 0)) return 1 + t0;
    }
    for (int l = 0; l < there; ++l) {
      const int t = t0 + l, g = pat[t];
      const REAL *m = M + (size_t)t * ne, *e = Es + l * ne;
      if (Sout) memcpy(Sout + (size_t)t * nd * ns, S, (size_t)nd * ns * sizeof(REAL));
      memset(dE, 0, (size_t)ne * ns * sizeof(REAL));
      sparse_dense(spE, E + l, S, dE, ns);
      scatter(spH, H + l, dE, ns);
      for (int i = 0; i < ne; ++i)
        if (m[i] == 0) memset(dE + (size_t)i * ns, 0, ns * sizeof(REAL));
      if (Jout) memcpy(Jout + (size_t)t * ne * ns, dE, (size_t)ne * ns * sizeof(REAL));
      memset(T, 0, (size_t)nd * ns * sizeof(REAL));
      sparse_dense(spA, A + l, S, T, ns);
      scatter(spB, B + l, T, ns);
      if (zero_gain[g]) {
        memcpy(S, T, (size_t)nd * ns * sizeof(REAL));
        continue;
      }
      const REAL *Kg = K + (size_t)g * nd * ne;
      memset(T2, 0, (size_t)nd * ns * sizeof(REAL));
      for (int i = 0; i < nd; ++i) {
        REAL *restrict dst = T2 + (size_t)i * ns;
        for (int j = 0; j < ne; ++j) {
          const REAL a = Kg[i * ne + j];
          if (a == 0) continue;
          const REAL *restrict src = dE + (size_t)j * ns;
          for (int c = 0; c < ns; ++c) dst[c] += a * src[c];
        }
        if (dK) {
          const REAL *D = dK + ((size_t)g * nd + i) * ne * ns;
          for (int j = 0; j < ne; ++j) {
            const REAL a = e[j];
            if (a == 0) continue;
            const REAL *restrict src = D + (size_t)j * ns;
            for (int c = 0; c < ns; ++c) dst[c] += a * src[c];
          }
        }
      }
      memset(Sn, 0, (size_t)nd * ns * sizeof(REAL));
      sparse_dense(sp1, J1 + l, T, Sn, ns);
      sparse_dense(sp2, J2 + l, T2, Sn, ns);
      memcpy(S, Sn, (size_t)nd * ns * sizeof(REAL));
    }
  }
  return 0;
}

/* Length of `buf` for gb_run. */
INT gb_buffer(int nx, int nd, int ne, int ny, int ns) {
  INT slopes = 0;
  for (int i = 0; i < 4; ++i) slopes += entries(gb_slope_sparsity_out(i));
  for (int i = 0; i < 2; ++i) slopes += entries(gb_turn_sparsity_out(i));
  return LANES * (2 * nx + ne + nd + slopes) + ny + (INT)ne * ns + 3 * (INT)nd * ns + 64;
}

/* Open-loop rollouts: from every start state x0 (m x nx) at record row k0[i], predict horizon samples.
   U as in gb_run; Yout (m x horizon x ny): outputs at rows k0, k0+1, ... (the first is the start's own output). */
int gb_rollout(int m, int horizon, int nx, int ny, int nu, const REAL *x0, const int *k0, const REAL *U, const REAL *p,
               REAL dt, REAL *Yout, REAL *Xout, const REAL **arg, REAL **res, INT *iw, REAL *w, REAL *buf) {
  REAL *x = buf, *xF = buf + nx;
  for (int i = 0; i < m; ++i) {
    memcpy(x, x0 + (size_t)i * nx, nx * sizeof(REAL));
    for (int h = 0; h < horizon; ++h) {
      arg[0] = x;
      arg[1] = U + (size_t)(k0[i] + h) * nu;
      arg[2] = p;
      arg[3] = &dt;
      res[0] = xF;
      res[1] = Yout + ((size_t)i * horizon + h) * ny;
      if (gb_pred(arg, res, iw, w, 0)) return 1 + i;
      if (Xout) memcpy(Xout + ((size_t)i * horizon + h) * nx, x, nx * sizeof(REAL));
      memcpy(x, xF, nx * sizeof(REAL));
    }
  }
  return 0;
}

/* Many short open-loop runs: window i starts at record row first[i] in state X[i] (m x nx, in/out: its end) with
   sensitivity S[i] (m x nd x ns, in/out, or NULL) and runs length[i] samples without correction; innovations (and their
   sensitivities) of its last tail[i] samples are appended to Eout (sum tail x ne) and Jout (sum tail x ne x ns, or NULL).
   Etmp, Jtmp hold one window. Returns 0, or 1 + i where window i stops being finite. */
int gb_windows(int m, const int *first, const int *length, const int *tail, int nx, int nd, int ne, int ny, int nu, int ns,
               REAL *X, REAL *S, const REAL *U, const REAL *Y, const REAL *M, const REAL *p, REAL dt, REAL *Eout,
               REAL *Jout, REAL *Etmp, REAL *Jtmp, const int *nopat, const int *one, const REAL **arg, REAL **res, INT *iw,
               REAL *w, REAL *buf) {
  size_t row = 0;
  for (int i = 0; i < m; ++i) {
    const size_t k = first[i], skip = length[i] - tail[i];
    if (gb_run(length[i], nx, nd, ne, ny, nu, ns, X + (size_t)i * nx, S ? S + (size_t)i * nd * ns : 0, U + k * nu,
               Y + k * ny, M + k * ne, nopat, p, dt, 0, one, 0, 0, Etmp, 0, S ? Jtmp : 0, 0, arg, res, iw, w, buf))
      return 1 + i;
    memcpy(Eout + row * ne, Etmp + skip * ne, tail[i] * ne * sizeof(REAL));
    if (S) memcpy(Jout + row * ne * ns, Jtmp + skip * ne * ns, (size_t)tail[i] * ne * ns * sizeof(REAL));
    row += tail[i];
  }
  return 0;
}
