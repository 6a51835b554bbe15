/* Filter and sensitivity recursion over one record, around one step and its linearisation.

   gb_value(x, U, y, p, dt) -> xF, e, yhat    (prediction, innovation; generated C)
   gb_move(xF, k)           -> x+             (x+ = xF boxplus k; generated C)
   slope: x, U, y, p, dt    -> A, B, E, H     (dxF/dx, dxF/dp, de/dx, de/dp; a tape)
   turn: xF, k              -> J1, J2         (dx+/dxF, dx+/dk; a tape)

   S (nd x ns, row-major) is the derivative of the error state with respect to the local parameters:
     dE = E S + H,   S+ = J1 (A S + B) + J2 (K dE + dK e)
   Columns of S: first the na active model parameters, then others (noise levels through dK, initial error states).
   The states of SAMPLES samples come first, one after the other, then their slopes side by side, then S. */

#include <string.h>

#define REAL double
typedef long long INT;
enum { SAMPLES = 32, TOGETHER = 8 };

/* A tape (tape.py) and the sparsities of its results; `slots` of work memory. */
typedef struct {
  const void *instructions;
  const REAL *constants;
  const INT *lengths;
  INT slots;
  const INT *sparsity[4];
} gb_linear;

extern int gb_value(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_value_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);
extern int gb_move(const REAL **arg, REAL **res, INT *iw, REAL *w, int mem);
extern int gb_move_work(INT *sz_arg, INT *sz_res, INT *sz_iw, INT *sz_w);
extern int gb_tape_width(int lanes);
extern void gb_tape(const void *instructions, const REAL *constants, const REAL **arg, REAL **res, const INT *lengths,
                    REAL *work, int lanes);

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

/* out (rows x n) = M1 in1 + M2 in2 (M2 NULL: without); m1, m2 their numbers. Eight columns at a time; the last
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
        ADD8(m1[M1->place[k]], in1 + (size_t)M1->column[k] * n + c);
      if (M2)
        for (int k = M2->start[i]; k < M2->start[i + 1]; ++k)
          ADD8(m2[M2->place[k]], in2 + (size_t)M2->column[k] * n + c);
      *(quad_at *)(dst + c) = low;
      *(quad_at *)(dst + c + 4) = high;
      c += 8;
    }
    for (; c < n; ++c) {
      REAL sum = 0;
      for (int k = M1->start[i]; k < M1->start[i + 1]; ++k)
        sum += m1[M1->place[k]] * in1[(size_t)M1->column[k] * n + c];
      if (M2)
        for (int k = M2->start[i]; k < M2->start[i + 1]; ++k)
          sum += m2[M2->place[k]] * in2[(size_t)M2->column[k] * n + c];
      dst[c] = sum;
    }
  }
}

/* Eight numbers in one register. */
typedef REAL eight __attribute__((vector_size(8 * sizeof(REAL))));
typedef REAL eight_at __attribute__((vector_size(8 * sizeof(REAL)), aligned(sizeof(REAL)), may_alias));

/* out (nd x n) = K (nd x ne) dE (ne x n), plus P (nd x nk) in its first nk columns (P NULL: without). Only the channels in
   `there` (many of them) count. */
static void correction(const REAL *K, const REAL *dE, const int *there, int many, const REAL *P, int nk, REAL *out, int nd,
                       int ne, int n) {
  for (int i = 0; i < nd; i += 4) {
    const int rows = nd - i < 4 ? nd - i : 4;
    const REAL *k[4];
    for (int r = 0; r < 4; ++r) k[r] = K + (size_t)(i + (r < rows ? r : rows - 1)) * ne;
    int c = 0;
    while (n >= 8 && c < n) {
      if (c > n - 8) c = n - 8;
      eight sum[4] = {{0}, {0}, {0}, {0}};
      for (int q = 0; q < many; ++q) {
        const int j = there[q];
        const eight d = *(const eight_at *)(dE + (size_t)j * n + c);
        for (int r = 0; r < 4; ++r) sum[r] += k[r][j] * d;
      }
      for (int r = 0; r < rows; ++r) *(eight_at *)(out + (size_t)(i + r) * n + c) = sum[r];
      c += 8;
    }
    for (; c < n; ++c)
      for (int r = 0; r < rows; ++r) {
        REAL sum = 0;
        for (int q = 0; q < many; ++q) sum += k[r][there[q]] * dE[(size_t)there[q] * n + c];
        out[(size_t)(i + r) * n + c] = sum;
      }
  }
  if (!P) return;
  for (int i = 0; i < nd; ++i)
    for (int c = 0; c < nk; ++c) out[(size_t)i * n + c] += P[(size_t)i * nk + c];
}

/* P[t] (nd x nk) = dK e[t] for `many` samples at most TOGETHER of one gain: dK (nk x nd x ne), e[t] (ne). */
static void pushes(const REAL *dK, const REAL *const *e, REAL *const *P, int many, int nd, int ne, int nk) {
  eight column[ne];
  int there[ne], some = 0;
  for (int j = 0; j < ne; ++j) {
    eight v = {0};
    int any = 0;
    for (int t = 0; t < many; ++t) {
      v[t] = e[t][j];
      any |= e[t][j] != 0;
    }
    column[some] = v;
    there[some] = j;
    some += any;
  }
  for (int s = 0; s < nk; ++s)
    for (int i = 0; i < nd; i += 4) {
      const REAL *d[4];
      eight sum[4] = {{0}, {0}, {0}, {0}};
      for (int r = 0; r < 4; ++r) d[r] = dK + ((size_t)s * nd + (i + r < nd ? i + r : nd - 1)) * ne;
      for (int q = 0; q < some; ++q)
        for (int r = 0; r < 4; ++r) sum[r] += d[r][there[q]] * column[q];
      for (int r = 0; r < 4 && i + r < nd; ++r)
        for (int t = 0; t < many; ++t) P[t][(size_t)(i + r) * nk + s] = sum[r][t];
    }
}

/* out (rows x n) += M (compressed columns) scattered: column c of M goes to column place[c] of out, a column
   with a negative place nowhere; place NULL: to the first columns in order */
static void scatter(const INT *sp, const int *place, const REAL *m, REAL *out, int n) {
  const INT nrow = sp[0], ncol = sp[1];
  const INT *colind = sp + 2, *row = sp + 3 + ncol;
  const int dense = is_dense(sp);
  for (INT c = 0; c < ncol; ++c) {
    const INT from = dense ? c * nrow : colind[c], to = dense ? from + nrow : colind[c + 1];
    const INT at = place ? place[c] : c;
    if (at < 0) continue;
    for (INT k = from; k < to; ++k) out[(dense ? k - from : row[k]) * n + at] += m[k];
  }
}

/* Sizes that the caller needs: number of pointers, integers and reals of work memory. */
void gb_sizes(INT *args, INT *ress, INT *iws, INT *ws) {
  INT a[2], r[2], i[2], w[2];
  gb_value_work(a, r, i, w);
  gb_move_work(a + 1, r + 1, i + 1, w + 1);
  *args = *ress = *iws = *ws = 0;
  for (int k = 0; k < 2; ++k) {
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

static INT numbers_of(const gb_linear *f, int results) {
  INT all = 0;
  for (int i = 0; i < results; ++i) all += f->lengths[i];
  return all;
}

/* Length of `buf` for gb_run; nk columns of the gain's derivative. */
INT gb_buffer(int nx, int nd, int ne, int ny, int ns, int nk, const gb_linear *slope, const gb_linear *turn) {
  const INT slots = slope->slots > turn->slots ? slope->slots : turn->slots;
  return SAMPLES * (2 * nx + ne + nd + numbers_of(slope, 4) + numbers_of(turn, 2) + (INT)nd * nk + slots) + ny +
         (INT)ne * ns + 3 * (INT)nd * ns + 64;
}

/* Sample `step` of window `window`. */
typedef struct {
  int window, step;
} place_of;

static place_of next(place_of at, const int *length) {
  return at.step + 1 < length[at.window] ? (place_of){at.window, at.step + 1} : (place_of){at.window + 1, 0};
}

/* Run m windows of a record, window i from its row first[i] on for length[i] samples; the last tail[i] are written. Arrays
   are row-major, time first.
   x (m x nx) in/out, S (m x nd*ns) in/out (NULL: no sensitivities); U ((n + past + future) x nu) with the record's first
   sample at row `past`; Y (n x ny, missing = any number); M (n x ne, 1 = there, 0 = missing); pat (n) index of the gain;
   K (npat x nd x ne, NULL: no correction), zero_gain (npat): 1 = none; dK: npat pointers to (nk x nd x ne), the derivative
   in the first nk columns (NULL: gain is constant);
   Xout (rows x nx), Eout (rows x ne), Yout (rows x ny), Jout (rows x ne x ns): any may be NULL; Sout (rows x nd x ns) too.
   place: where the parameters of `slope` stand among the columns of S (see scatter).
   Returns 0, or 1 when the numbers stop being finite, at `failed`. */
static int run(int m, const int *first, const int *length, const int *tail, int nx, int nd, int ne, int ny, int nu, int ns,
               int nk, const gb_linear *slope, const gb_linear *turn, REAL *x, REAL *S, const REAL *U, const REAL *Y,
               const REAL *M, const int *pat, const REAL *p, REAL dt, const REAL *K, const int *zero_gain,
               const REAL *const *dK, REAL *Xout, REAL *Eout, REAL *Yout, REAL *Jout, REAL *Sout, const int *place,
               const REAL **arg, REAL **res, INT *iw, REAL *w, REAL *buf, place_of *failed) {
  const INT *lA = slope->lengths, *lJ = turn->lengths;
  const size_t pushed = (size_t)nd * nk, of_state = (size_t)nd * ns;
  REAL *X = buf, *XF = X + SAMPLES * nx, *Es = XF + SAMPLES * nx, *Ks = Es + SAMPLES * ne, *yh = Ks + SAMPLES * nd,
       *A = yh + ny, *B = A + SAMPLES * lA[0], *E = B + SAMPLES * lA[1], *H = E + SAMPLES * lA[2],
       *J1 = H + SAMPLES * lA[3], *J2 = J1 + SAMPLES * lJ[0], *dE = J2 + SAMPLES * lJ[1], *T = dE + ne * ns,
       *T2 = T + of_state, *Sn = T2 + of_state, *P = Sn + of_state, *slots = P + SAMPLES * pushed;
  int memA[by_rows_length(slope->sparsity[0])], memE[by_rows_length(slope->sparsity[2])],
      mem1[by_rows_length(turn->sparsity[0])], mem2[by_rows_length(turn->sparsity[1])];
  const by_rows rA = make_by_rows(slope->sparsity[0], memA), rE = make_by_rows(slope->sparsity[2], memE),
                r1 = make_by_rows(turn->sparsity[0], mem1), r2 = make_by_rows(turn->sparsity[1], mem2);
  const REAL *many[5 * SAMPLES];
  REAL *out[4];
  size_t row = 0;
  for (place_of at = {0, 0}; at.window < m;) {
    place_of block[SAMPLES];
    int there = 0, corrected = 0;
    for (; there < SAMPLES && at.window < m; ++there, at = next(at, length)) {
      const int t = first[at.window] + at.step;
      const REAL *seen = M + (size_t)t * ne;
      REAL *now = x + (size_t)at.window * nx, *xF = XF + there * nx, *e = Es + there * ne, *k = Ks + there * nd;
      const size_t to = row + there;
      block[there] = *failed = at;
      memcpy(X + there * nx, now, nx * sizeof(REAL));
      arg[0] = now;
      arg[1] = U + (size_t)t * nu;
      arg[2] = Y + (size_t)t * ny;
      arg[3] = p;
      arg[4] = &dt;
      res[0] = xF; res[1] = e; res[2] = yh;
      if (gb_value(arg, res, iw, w, 0)) return 1;
      for (int i = 0; i < ne; ++i) e[i] = seen[i] != 0 ? e[i] : 0;
      if (!K || zero_gain[pat[t]]) {
        memset(k, 0, nd * sizeof(REAL));
        memcpy(now, xF, nx * sizeof(REAL));
      } else {
        const REAL *Kg = K + (size_t)pat[t] * nd * ne;
        for (int i = 0; i < nd; ++i) {
          REAL s = 0;
          for (int j = 0; j < ne; ++j) s += Kg[i * ne + j] * e[j];
          k[i] = s;
        }
        arg[0] = xF; arg[1] = k;
        res[0] = now;
        if (gb_move(arg, res, iw, w, 0)) return 1;
        corrected = 1;
      }
      for (int i = 0; i < nx; ++i)
        if (!(now[i] - now[i] == 0)) return 1;
      if (Xout) memcpy(Xout + to * nx, X + there * nx, nx * sizeof(REAL));
      if (Yout) memcpy(Yout + to * ny, yh, ny * sizeof(REAL));
    }
    if (S) {
      const int wide = 8 * gb_tape_width(there);
      for (int l = 0; l < wide; ++l) {
        const int s = l < there ? l : there - 1, t = first[block[s].window] + block[s].step;
        many[l] = X + s * nx;
        many[wide + l] = U + (size_t)t * nu;
        many[2 * wide + l] = Y + (size_t)t * ny;
        many[3 * wide + l] = p;
        many[4 * wide + l] = &dt;
      }
      out[0] = A; out[1] = B; out[2] = E; out[3] = H;
      gb_tape(slope->instructions, slope->constants, many, out, lA, slots, there);
      if (corrected) {
        for (int l = 0; l < wide; ++l) {
          const int s = l < there ? l : there - 1;
          many[l] = XF + s * nx;
          many[wide + l] = Ks + s * nd;
        }
        out[0] = J1; out[1] = J2;
        gb_tape(turn->instructions, turn->constants, many, out, lJ, slots, there);
      }
    }
    int known[SAMPLES] = {0}; /* whose dK e is in P */
    for (int l = 0; l < there; ++l) {
      const int i = block[l].window, t = first[i] + block[l].step, g = pat ? pat[t] : 0;
      const int kept = block[l].step >= length[i] - tail[i];
      if (kept && Eout) memcpy(Eout + row * ne, Es + l * ne, ne * sizeof(REAL));
      if (S) {
        REAL *s = S + i * of_state;
        int seen[ne], channels = 0;
        if (kept && Sout) memcpy(Sout + row * of_state, s, of_state * sizeof(REAL));
        product(&rE, E + l * lA[2], s, 0, 0, 0, dE, ns);
        scatter(slope->sparsity[3], place, H + l * lA[3], dE, ns);
        for (int j = 0; j < ne; ++j) {
          if (M[(size_t)t * ne + j] != 0)
            seen[channels++] = j;
          else
            memset(dE + (size_t)j * ns, 0, ns * sizeof(REAL));
        }
        if (kept && Jout) memcpy(Jout + row * ne * ns, dE, (size_t)ne * ns * sizeof(REAL));
        product(&rA, A + l * lA[0], s, 0, 0, 0, T, ns);
        scatter(slope->sparsity[1], place, B + l * lA[1], T, ns);
        if (!K || zero_gain[g]) {
          memcpy(s, T, of_state * sizeof(REAL));
        } else {
          if (dK && !known[l]) {
            const REAL *e[TOGETHER];
            REAL *push[TOGETHER];
            int same = 0;
            for (int k = l; k < there && same < TOGETHER; ++k)
              if (pat[first[block[k].window] + block[k].step] == g) {
                e[same] = Es + k * ne;
                push[same++] = P + k * pushed;
                known[k] = 1;
              }
            pushes(dK[g], e, push, same, nd, ne, nk);
          }
          correction(K + (size_t)g * nd * ne, dE, seen, channels, dK ? P + l * pushed : 0, nk, T2, nd, ne, ns);
          product(&r1, J1 + l * lJ[0], T, &r2, J2 + l * lJ[1], T2, Sn, ns);
          memcpy(s, Sn, of_state * sizeof(REAL));
        }
      }
      row += kept;
    }
  }
  return 0;
}

/* The n samples of a record as one window, see `run`. Returns 0, or 1 + k when the numbers stop being finite at sample k. */
int gb_run(int n, int nx, int nd, int ne, int ny, int nu, int ns, int nk, const gb_linear *slope, const gb_linear *turn,
           REAL *x, REAL *S, const REAL *U, const REAL *Y, const REAL *M, const int *pat, const REAL *p, REAL dt,
           const REAL *K, const int *zero_gain, const REAL *const *dK, REAL *Xout, REAL *Eout, REAL *Yout, REAL *Jout,
           REAL *Sout, const int *place, const REAL **arg, REAL **res, INT *iw, REAL *w, REAL *buf) {
  const int first = 0;
  place_of failed = {0, 0};
  if (n && run(1, &first, &n, &n, nx, nd, ne, ny, nu, ns, nk, slope, turn, x, S, U, Y, M, pat, p, dt, K, zero_gain, dK,
               Xout, Eout, Yout, Jout, Sout, place, arg, res, iw, w, buf, &failed))
    return 1 + failed.step;
  return 0;
}

/* Many short open-loop runs, see `run`: innovations (and their sensitivities) of the last tail[i] samples of each are
   appended to Eout and Jout (NULL: without). Returns 0, or 1 + i where window i stops being finite. */
int gb_windows(int m, const int *first, const int *length, const int *tail, int nx, int nd, int ne, int ny, int nu, int ns,
               const gb_linear *slope, const gb_linear *turn, REAL *X, REAL *S, const REAL *U, const REAL *Y,
               const REAL *M, const REAL *p, REAL dt, REAL *Eout, REAL *Jout, const int *place, const REAL **arg,
               REAL **res, INT *iw, REAL *w, REAL *buf) {
  place_of failed = {0, 0};
  if (run(m, first, length, tail, nx, nd, ne, ny, nu, ns, 0, slope, turn, X, S, U, Y, M, 0, p, dt, 0, 0, 0, 0, Eout, 0, Jout,
          0, place, arg, res, iw, w, buf, &failed))
    return 1 + failed.window;
  return 0;
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
      arg[2] = 0; /* nothing is measured: zeros */
      arg[3] = p;
      arg[4] = &dt;
      res[0] = xF;
      res[1] = 0;
      res[2] = Yout + ((size_t)i * horizon + h) * ny;
      if (gb_value(arg, res, iw, w, 0)) return 1 + i;
      if (Xout) memcpy(Xout + ((size_t)i * horizon + h) * nx, x, nx * sizeof(REAL));
      memcpy(x, xF, nx * sizeof(REAL));
    }
  }
  return 0;
}
