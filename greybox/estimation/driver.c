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

/* Two registers of four numbers. */
typedef REAL quad __attribute__((vector_size(4 * sizeof(REAL))));
typedef REAL quad_at __attribute__((vector_size(4 * sizeof(REAL)), aligned(sizeof(REAL)), may_alias));
#define ADD8(factor, from)                           \
  do {                                               \
    const REAL f_ = (factor), *v_ = (from);          \
    low += f_ * *(const quad_at *)v_;                \
    high += f_ * *(const quad_at *)(v_ + 4);         \
  } while (0)

/* A sparsity by rows: entries start[i] .. start[i + 1] of row i, each its place in the column-wise numbers and its column. */
typedef struct {
  int rows, *start, *place, *column;
} by_rows;

static int by_rows_length(const INT *sp) { return (int)(sp[0] + 1 + 2 * entries(sp)); }

/* Fills `memory` (by_rows_length integers). */
static by_rows make_by_rows(const INT *sp, int *memory) {
  const INT nrow = sp[0], ncol = sp[1];
  const INT *colind = sp + 2, *row = sp + 3 + ncol;
  const int dense = is_dense(sp), nnz = (int)entries(sp);
  by_rows r = {(int)nrow, memory, memory + nrow + 1, memory + nrow + 1 + nnz};
  for (INT i = 0; i <= nrow; ++i) r.start[i] = 0;
  for (int k = 0; k < nnz; ++k) ++r.start[(dense ? k % nrow : row[k]) + 1];
  for (INT i = 0; i < nrow; ++i) r.start[i + 1] += r.start[i];
  for (INT c = 0; c < ncol; ++c)
    for (INT k = dense ? c * nrow : colind[c]; k < (dense ? (c + 1) * nrow : colind[c + 1]); ++k) {
      const int at = r.start[dense ? k - c * nrow : row[k]]++;
      r.place[at] = (int)k;
      r.column[at] = (int)c;
    }
  for (INT i = nrow; i > 0; --i) r.start[i] = r.start[i - 1];
  r.start[0] = 0;
  return r;
}

/* out (rows x n) = M1 in1 + M2 in2 (M2 NULL: without); m1, m2 one lane of the numbers. Eight columns at a time; the last
   eight may overlap those before, which changes nothing. */
static void product(const by_rows *M1, const REAL *m1, const REAL *in1, const by_rows *M2, const REAL *m2, const REAL *in2,
                    REAL *out, int n) {
  for (int i = 0; i < M1->rows; ++i) {
    REAL *dst = out + (size_t)i * n;
    int c = 0;
    while (n >= 8 && c < n) {
      if (c > n - 8) c = n - 8;
      quad low = {0}, high = {0};
      for (int k = M1->start[i]; k < M1->start[i + 1]; ++k)
        ADD8(m1[M1->place[k] * LANES], in1 + (size_t)M1->column[k] * n + c);
      if (M2)
        for (int k = M2->start[i]; k < M2->start[i + 1]; ++k)
          ADD8(m2[M2->place[k] * LANES], in2 + (size_t)M2->column[k] * n + c);
      *(quad_at *)(dst + c) = low;
      *(quad_at *)(dst + c + 4) = high;
      c += 8;
    }
    for (; c < n; ++c) {
      REAL sum = 0;
      for (int k = M1->start[i]; k < M1->start[i + 1]; ++k)
        sum += m1[M1->place[k] * LANES] * in1[(size_t)M1->column[k] * n + c];
      if (M2)
        for (int k = M2->start[i]; k < M2->start[i + 1]; ++k)
          sum += m2[M2->place[k] * LANES] * in2[(size_t)M2->column[k] * n + c];
      dst[c] = sum;
    }
  }
}

/* out (n) = K (ne) dE (ne x n) + e (ne) D (ne x n) (D NULL: without), one row of K dE + dK e. */
static void correction(const REAL *K, const REAL *dE, const REAL *e, const REAL *D, REAL *out, int ne, int n) {
  int c = 0;
  while (n >= 8 && c < n) {
    if (c > n - 8) c = n - 8;
    quad low = {0}, high = {0};
    for (int j = 0; j < ne; ++j) ADD8(K[j], dE + (size_t)j * n + c);
    if (D)
      for (int j = 0; j < ne; ++j) ADD8(e[j], D + (size_t)j * n + c);
    *(quad_at *)(out + c) = low;
    *(quad_at *)(out + c + 4) = high;
    c += 8;
  }
  for (; c < n; ++c) {
    REAL sum = 0;
    for (int j = 0; j < ne; ++j) sum += K[j] * dE[(size_t)j * n + c] + (D ? e[j] * D[(size_t)j * n + c] : 0);
    out[c] = sum;
  }
}

/* out (rows x n) += M (compressed columns, one lane of it) scattered: column c of M goes to column place[c] of out, a column
   with a negative place nowhere; place NULL: to the first columns in order */
static void scatter(const INT *sp, const int *place, const REAL *m, REAL *out, int n) {
  const INT nrow = sp[0], ncol = sp[1];
  const INT *colind = sp + 2, *row = sp + 3 + ncol;
  const int dense = is_dense(sp);
  for (INT c = 0; c < ncol; ++c) {
    const INT from = dense ? c * nrow : colind[c], to = dense ? from + nrow : colind[c + 1];
    const INT at = place ? place[c] : c;
    if (at < 0) continue;
    for (INT k = from; k < to; ++k) out[(dense ? k - from : row[k]) * n + at] += m[k * LANES];
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
   place: where the parameters of gb_slope stand among the columns of S (see scatter).
   Returns 0, or 1 + k when the numbers stop being finite at sample k. */
int gb_run(int n, int nx, int nd, int ne, int ny, int nu, int ns, REAL *x, REAL *S, const REAL *U, const REAL *Y,
           const REAL *M, const int *pat, const REAL *p, REAL dt, const REAL *K, const int *zero_gain, const REAL *dK,
           REAL *Xout, REAL *Eout, REAL *Yout, REAL *Jout, REAL *Sout, const int *place, const REAL **arg, REAL **res,
           INT *iw, REAL *w, REAL *buf) {
  const INT *spA = gb_slope_sparsity_out(0), *spB = gb_slope_sparsity_out(1), *spE = gb_slope_sparsity_out(2),
            *spH = gb_slope_sparsity_out(3), *sp1 = gb_turn_sparsity_out(0), *sp2 = gb_turn_sparsity_out(1);
  REAL *X = buf, *XF = X + LANES * nx, *Es = XF + LANES * nx, *Ks = Es + LANES * ne, *yh = Ks + LANES * nd,
       *A = yh + ny, *B = A + LANES * entries(spA), *E = B + LANES * entries(spB), *H = E + LANES * entries(spE),
       *J1 = H + LANES * entries(spH), *J2 = J1 + LANES * entries(sp1), *dE = J2 + LANES * entries(sp2),
       *T = dE + ne * ns, *T2 = T + nd * ns, *Sn = T2 + nd * ns;
  int memA[by_rows_length(spA)], memE[by_rows_length(spE)], mem1[by_rows_length(sp1)], mem2[by_rows_length(sp2)];
  by_rows rA, rE, r1, r2;
  if (S) {
    rA = make_by_rows(spA, memA);
    rE = make_by_rows(spE, memE);
    r1 = make_by_rows(sp1, mem1);
    r2 = make_by_rows(sp2, mem2);
  }
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
      product(&rE, E + l, S, 0, 0, 0, dE, ns);
      scatter(spH, place, H + l, dE, ns);
      for (int i = 0; i < ne; ++i)
        if (m[i] == 0) memset(dE + (size_t)i * ns, 0, ns * sizeof(REAL));
      if (Jout) memcpy(Jout + (size_t)t * ne * ns, dE, (size_t)ne * ns * sizeof(REAL));
      product(&rA, A + l, S, 0, 0, 0, T, ns);
      scatter(spB, place, B + l, T, ns);
      if (zero_gain[g]) {
        memcpy(S, T, (size_t)nd * ns * sizeof(REAL));
        continue;
      }
      const REAL *Kg = K + (size_t)g * nd * ne;
      for (int i = 0; i < nd; ++i)
        correction(Kg + i * ne, dE, e, dK ? dK + ((size_t)g * nd + i) * ne * ns : 0, T2 + (size_t)i * ns, ne, ns);
      product(&r1, J1 + l, T, &r2, J2 + l, T2, Sn, ns);
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
               REAL *Jout, REAL *Etmp, REAL *Jtmp, const int *nopat, const int *one, const int *place, const REAL **arg,
               REAL **res, INT *iw, REAL *w, REAL *buf) {
  size_t row = 0;
  for (int i = 0; i < m; ++i) {
    const size_t k = first[i], skip = length[i] - tail[i];
    if (gb_run(length[i], nx, nd, ne, ny, nu, ns, X + (size_t)i * nx, S ? S + (size_t)i * nd * ns : 0, U + k * nu,
               Y + k * ny, M + k * ne, nopat, p, dt, 0, one, 0, 0, Etmp, 0, S ? Jtmp : 0, 0, place, arg, res, iw, w, buf))
      return 1 + i;
    memcpy(Eout + row * ne, Etmp + skip * ne, tail[i] * ne * sizeof(REAL));
    if (S) memcpy(Jout + row * ne * ns, Jtmp + skip * ne * ns, (size_t)tail[i] * ne * ns * sizeof(REAL));
    row += tail[i];
  }
  return 0;
}
