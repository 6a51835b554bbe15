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
enum { SAMPLES = 32 };

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

/* WIDE columns of S are carried through a block of samples at a time: they and the slopes of the gain then stay near the
   processor. A vector is one register of the processor: compilers take a longer one apart through memory. ROWS of a product
   with PARTS sums each fill half of the registers. */
#if defined __AVX512F__
#define REGISTER 64
#elif defined __AVX__
#define REGISTER 32
#else
#define REGISTER 16
#endif
enum { WIDE = 16, PARTS = WIDE * sizeof(REAL) / REGISTER, ROWS = REGISTER / 16, PACKS = 8 };
/* A short loop of a length that is known: what it sums stays in registers where it is written out. -O3 writes out many more,
   and takes the compiler several times as long. */
#define WRITTEN_OUT _Pragma("GCC unroll 8")
typedef REAL vector __attribute__((vector_size(REGISTER), may_alias));

/* sum += row i of M (its numbers m) times the rows of `in` (n x WIDE). */
static inline void add_row(const by_rows *M, const REAL *m, int i, const REAL *in, vector *sum) {
  for (int k = M->start[i]; k < M->start[i + 1]; ++k) {
    const REAL f = m[M->place[k]];
    const vector *v = (const vector *)(in + (size_t)M->column[k] * WIDE);
    WRITTEN_OUT for (int q = 0; q < PARTS; ++q) sum[q] += f * v[q];
  }
}

/* Row i of out = M1 in1 + M2 in2 (M2 NULL: without); m1, m2 their numbers. */
static inline void set_row(const by_rows *M1, const REAL *m1, int i, const REAL *in1, const by_rows *M2, const REAL *m2,
                           const REAL *in2, REAL *out) {
  vector sum[PARTS] = {{0}};
  add_row(M1, m1, i, in1, sum);
  if (M2) add_row(M2, m2, i, in2, sum);
  WRITTEN_OUT for (int q = 0; q < PARTS; ++q) ((vector *)(out + (size_t)i * WIDE))[q] = sum[q];
}

/* The entries of a sparse matrix by the columns of S that they are added to: entries start[g] .. start[g + 1] go to
   columns WIDE g and on, number place[k] to `to[k]` of these (rows x WIDE). */
typedef struct {
  int *start, *place, *to;
} by_columns;

static int by_columns_length(const INT *sp, int ns) { return ns / WIDE + 2 + 2 * (int)entries(sp); }

/* Fills `memory` (by_columns_length integers). Column c goes to column place[c] of S, one with a negative place nowhere;
   place NULL: to the first columns in order. */
static by_columns make_by_columns(const INT *sp, const int *place, int ns, int *memory) {
  const INT nrow = sp[0], ncol = sp[1];
  const INT *colind = sp + 2, *row = sp + 3 + ncol;
  const int dense = is_dense(sp), groups = ns / WIDE + 1, nnz = (int)entries(sp);
  by_columns r = {memory, memory + groups + 1, memory + groups + 1 + nnz};
  int n = 0;
  for (int g = 0; g < groups; ++g) {
    r.start[g] = n;
    for (INT c = 0; c < ncol; ++c) {
      const INT at = place ? place[c] : c;
      if (at < 0 || at / WIDE != g) continue;
      for (INT k = dense ? c * nrow : colind[c]; k < (dense ? (c + 1) * nrow : colind[c + 1]); ++k, ++n) {
        r.place[n] = (int)k;
        r.to[n] = (int)((dense ? k - c * nrow : row[k]) * WIDE + at % WIDE);
      }
    }
  }
  r.start[groups] = n;
  return r;
}

/* out (rows x WIDE) += the entries m of M in group g. */
static inline void add_group(const by_columns *M, const REAL *m, int g, REAL *out) {
  for (int k = M->start[g]; k < M->start[g + 1]; ++k) out[M->to[k]] += m[M->place[k]];
}

/* packed (nd x ne x WIDE) from dK (nk x nd x ne): columns `from` and on of ns, zero where none of the `moving` (nk,
   ascending) is that column. */
static void pack(const REAL *dK, const int *moving, int nk, int from, int all, REAL *packed) {
  memset(packed, 0, (size_t)all * WIDE * sizeof(REAL));
  for (int n = 0; n < nk; ++n) {
    const int s = moving[n] - from;
    const REAL *d = dK + (size_t)n * all;
    if (s >= 0 && s < WIDE)
      for (int i = 0; i < all; ++i) packed[(size_t)i * WIDE + s] = d[i];
  }
}

/* out (nd x WIDE) = K (nd x ne) dE (ne x WIDE) + dK e; dK is packed, or NULL. Only the `many` channels in `there` count. */
static void correction(const REAL *K, const REAL *dE, const REAL *dK, const REAL *e, const int *there, int many, REAL *out,
                       int nd, int ne) {
  for (int i = 0; i < nd; i += ROWS) {
    vector sum[ROWS][PARTS] = {{{0}}};
    const REAL *k[ROWS], *d[ROWS];
    WRITTEN_OUT for (int r = 0; r < ROWS; ++r) {
      const size_t at = (size_t)(i + r < nd ? i + r : nd - 1) * ne;
      k[r] = K + at;
      d[r] = dK ? dK + at * WIDE : 0;
    }
    for (int c = 0; c < many; ++c) {
      const int j = there[c];
      const vector *v = (const vector *)(dE + j * WIDE);
      WRITTEN_OUT for (int r = 0; r < ROWS; ++r)
        WRITTEN_OUT for (int q = 0; q < PARTS; ++q) sum[r][q] += k[r][j] * v[q];
    }
    if (dK)
      for (int c = 0; c < many; ++c) {
        const int j = there[c];
        const REAL f = e[j];
        WRITTEN_OUT for (int r = 0; r < ROWS; ++r)
          WRITTEN_OUT for (int q = 0; q < PARTS; ++q) sum[r][q] += f * ((const vector *)(d[r] + (size_t)j * WIDE))[q];
      }
    for (int r = 0; r < ROWS && i + r < nd; ++r)
      WRITTEN_OUT for (int q = 0; q < PARTS; ++q) ((vector *)(out + (size_t)(i + r) * WIDE))[q] = sum[r][q];
  }
}

/* `width` columns of a matrix with n columns to and from one with WIDE, whose other columns are zero. */
static void take(const REAL *from, int rows, int n, int width, REAL *to) {
  for (int i = 0; i < rows; ++i)
    for (int c = 0; c < WIDE; ++c) to[i * WIDE + c] = c < width ? from[(size_t)i * n + c] : 0;
}

static void give(const REAL *from, int rows, int n, int width, REAL *to) {
  for (int i = 0; i < rows; ++i) memcpy(to + (size_t)i * n, from + i * WIDE, width * sizeof(REAL));
}

/* The recursion of the slopes: sizes, sparsities, and the numbers of the samples of a block, side by side. */
typedef struct {
  int nd, ne;
  by_rows A, E, J1, J2;
  by_columns B, H;
  const INT *lA, *lJ; /* numbers of A, B, E, H and of J1, J2 in one sample */
  const REAL *a, *b, *e, *h, *j1, *j2;
} recursion;

/* dE (ne x WIDE) of sample l of a block, columns WIDE g and on, zero where `seen` (ne) is, from s (nd x WIDE). Gives how
   many channels are `there` (ne), and which. */
static int innovation_slope(const recursion *r, int l, int g, const REAL *seen, const REAL *s, REAL *dE, int *there) {
  const REAL *c = r->e + l * r->lA[2], *h = r->h + l * r->lA[3];
  int many = 0;
  for (int i = 0; i < r->ne; ++i) {
    if (seen[i] != 0) there[many++] = i;
    set_row(&r->E, c, i, s, 0, 0, 0, dE);
  }
  add_group(&r->H, h, g, dE);
  for (int i = 0; i < r->ne; ++i)
    if (seen[i] == 0) memset(dE + i * WIDE, 0, WIDE * sizeof(REAL));
  return many;
}

/* Sample l of a block, columns WIDE g and on: dE (ne x WIDE) where `seen` (ne) says what is (NULL: nobody asks), and after
   (nd x WIDE) from s (nd x WIDE). K (nd x ne; NULL: no correction), dK packed (NULL: none), innovations e; T, T2 (nd x WIDE)
   are scratch. */
static void one_sample(const recursion *r, int l, int g, const REAL *seen, const REAL *K, const REAL *dK, const REAL *e,
                       const REAL *s, REAL *dE, REAL *T, REAL *T2, REAL *after) {
  const REAL *a = r->a + l * r->lA[0], *b = r->b + l * r->lA[1], *j1 = r->j1 + l * r->lJ[0], *j2 = r->j2 + l * r->lJ[1];
  int there[r->ne], many = seen ? innovation_slope(r, l, g, seen, s, dE, there) : 0;
  REAL *const moved = K ? T : after;
  for (int i = 0; i < r->nd; ++i) set_row(&r->A, a, i, s, 0, 0, 0, moved);
  add_group(&r->B, b, g, moved);
  if (!K) return;
  correction(K, dE, dK, e, there, many, T2, r->nd, r->ne);
  for (int i = 0; i < r->nd; ++i) set_row(&r->J1, j1, i, T, &r->J2, j2, T2, after);
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
INT gb_buffer(int nx, int nd, int ne, int ny, int nk, const gb_linear *slope, const gb_linear *turn) {
  const INT slots = slope->slots > turn->slots ? slope->slots : turn->slots;
  return SAMPLES * (2 * nx + ne + nd + numbers_of(slope, 4) + numbers_of(turn, 2) + slots) + ny +
         WIDE * ((INT)ne + 4 * nd + (nk ? PACKS * (INT)nd * ne : 0)) + 64;
}

/* Sample `step` of window `window`. */
typedef struct {
  int window, step;
} place_of;

/* Whether a sample of a window is written: it is among the last tail[i], and at a step that is asked for (NULL: at all). */
static int is_kept(place_of at, const int *length, const int *tail, const int *asked) {
  return at.step >= length[at.window] - tail[at.window] && (!asked || asked[at.step]);
}

static place_of next(place_of at, const int *length) {
  return at.step + 1 < length[at.window] ? (place_of){at.window, at.step + 1} : (place_of){at.window + 1, 0};
}

/* Run m windows of a record, window i from its row first[i] on for length[i] samples; the last tail[i] are written, as far
   as their step is `asked` for. Arrays are row-major, time first.
   x (m x nx) in/out, S (m x nd*ns) in/out (NULL: no sensitivities); U ((n + past + future) x nu) with the record's first
   sample at row `past`; Y (n x ny, missing = any number); M (n x ne, 1 = there, 0 = missing); pat (n) index of the gain;
   K (npat x nd x ne, NULL: no correction), zero_gain (npat): 1 = none; dK: npat pointers to (nk x nd x ne), the derivative
   in the columns `moving` (nk, ascending) of S (NULL: gain is constant);
   Xout (rows x nx), Eout (rows x ne), Yout (rows x ny), Jout (rows x ne x ns): any may be NULL; Sout (rows x nd x ns) too.
   place: where the parameters of `slope` stand among the columns of S (see make_by_columns).
   Returns 0, or 1 when the numbers stop being finite, at `failed`. */
static int run(int m, const int *first, const int *length, const int *tail, const int *asked, int nx, int nd, int ne, int ny,
               int nu, int ns, int nk, const gb_linear *slope, const gb_linear *turn, REAL *x, REAL *S, const REAL *U,
               const REAL *Y, const REAL *M, const int *pat, const REAL *p, REAL dt, const REAL *K, const int *zero_gain,
               const REAL *const *dK, const int *moving, REAL *Xout, REAL *Eout, REAL *Yout, REAL *Jout, REAL *Sout,
               const int *place, const REAL **arg, REAL **res, INT *iw, REAL *w, REAL *buf, place_of *failed) {
  const INT *lA = slope->lengths, *lJ = turn->lengths;
  const size_t of_state = (size_t)nd * ns, of_gain = (size_t)nd * ne;
  const int last = nk ? moving[nk - 1] : -1; /* column that a slope of the gain moves */
  REAL *dE = (REAL *)(((size_t)buf + 63) & ~(size_t)63), *s = dE + ne * WIDE, *after = s + nd * WIDE,
       *T = after + nd * WIDE, *T2 = T + nd * WIDE, *packs = T2 + nd * WIDE, *X = packs + (nk ? PACKS * of_gain * WIDE : 0),
       *XF = X + SAMPLES * nx, *Es = XF + SAMPLES * nx, *Ks = Es + SAMPLES * ne, *yh = Ks + SAMPLES * nd, *A = yh + ny,
       *B = A + SAMPLES * lA[0], *E = B + SAMPLES * lA[1], *H = E + SAMPLES * lA[2], *J1 = H + SAMPLES * lA[3],
       *J2 = J1 + SAMPLES * lJ[0], *slots = J2 + SAMPLES * lJ[1];
  const INT *const *sp = slope->sparsity, *const *st = turn->sparsity;
  int memA[by_rows_length(sp[0])], memB[by_columns_length(sp[1], ns)], memE[by_rows_length(sp[2])],
      memH[by_columns_length(sp[3], ns)], mem1[by_rows_length(st[0])], mem2[by_rows_length(st[1])];
  const recursion r = {nd, ne, make_by_rows(sp[0], memA), make_by_rows(sp[2], memE), make_by_rows(st[0], mem1),
                       make_by_rows(st[1], mem2), make_by_columns(sp[1], place, ns, memB),
                       make_by_columns(sp[3], place, ns, memH), lA, lJ, A, B, E, H, J1, J2};
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
    size_t rows[SAMPLES];
    for (int l = 0; l < there; ++l) {
      rows[l] = row;
      if (!is_kept(block[l], length, tail, asked)) continue;
      if (Eout) memcpy(Eout + row * ne, Es + l * ne, ne * sizeof(REAL));
      ++row;
    }
    for (int from = 0; S && from < ns; from += WIDE) {
      const int width = ns - from < WIDE ? ns - from : WIDE;
      int packed[PACKS];
      for (int k = 0; k < PACKS; ++k) packed[k] = -1;
      for (int l = 0; l < there; ++l) {
        const int i = block[l].window, t = first[i] + block[l].step, gain = pat ? pat[t] : 0;
        const int kept = is_kept(block[l], length, tail, asked), corrects = K && !zero_gain[gain];
        REAL *pack_of = 0, *const own = S + i * of_state + from;
        if (l == 0 || block[l - 1].window != i) take(own, nd, ns, width, s);
        if (kept && Sout) give(s, nd, ns, width, Sout + rows[l] * of_state + from);
        if (corrects && dK && from <= last) {
          pack_of = packs + gain % PACKS * of_gain * WIDE;
          if (packed[gain % PACKS] != gain) pack(dK[gain], moving, nk, from, nd * ne, pack_of);
          packed[gain % PACKS] = gain;
        }
        one_sample(&r, l, from / WIDE, kept || corrects ? M + (size_t)t * ne : 0, corrects ? K + gain * of_gain : 0, pack_of,
                   Es + l * ne, s, dE, T, T2, after);
        if (kept && Jout) give(dE, ne, ns, width, Jout + rows[l] * ne * ns + from);
        REAL *const before = s;
        s = after;
        after = before;
        if (l + 1 == there || block[l + 1].window != i) give(s, nd, ns, width, own);
      }
    }
  }
  return 0;
}

/* The n samples of a record as one window, see `run`. Returns 0, or 1 + k when the numbers stop being finite at sample k. */
int gb_run(int n, int nx, int nd, int ne, int ny, int nu, int ns, int nk, const gb_linear *slope, const gb_linear *turn,
           REAL *x, REAL *S, const REAL *U, const REAL *Y, const REAL *M, const int *pat, const REAL *p, REAL dt,
           const REAL *K, const int *zero_gain, const REAL *const *dK, const int *moving, REAL *Xout, REAL *Eout,
           REAL *Yout, REAL *Jout, REAL *Sout, const int *place, const REAL **arg, REAL **res, INT *iw, REAL *w, REAL *buf) {
  const int first = 0;
  place_of failed = {0, 0};
  if (n && run(1, &first, &n, &n, 0, nx, nd, ne, ny, nu, ns, nk, slope, turn, x, S, U, Y, M, pat, p, dt, K, zero_gain, dK,
               moving, Xout, Eout, Yout, Jout, Sout, place, arg, res, iw, w, buf, &failed))
    return 1 + failed.step;
  return 0;
}

/* Many short open-loop runs, see `run`: innovations (and their sensitivities) of the last tail[i] samples of each, where
   `asked` for, are appended to Eout and Jout (NULL: without). Returns 0, or 1 + i where window i stops being finite. */
int gb_windows(int m, const int *first, const int *length, const int *tail, const int *asked, int nx, int nd, int ne, int ny,
               int nu, int ns, const gb_linear *slope, const gb_linear *turn, REAL *X, REAL *S, const REAL *U, const REAL *Y,
               const REAL *M, const REAL *p, REAL dt, REAL *Eout, REAL *Jout, const int *place, const REAL **arg,
               REAL **res, INT *iw, REAL *w, REAL *buf) {
  place_of failed = {0, 0};
  if (run(m, first, length, tail, asked, nx, nd, ne, ny, nu, ns, 0, slope, turn, X, S, U, Y, M, 0, p, dt, 0, 0, 0, 0, 0, Eout,
          0, Jout, 0, place, arg, res, iw, w, buf, &failed))
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
