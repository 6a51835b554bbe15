/* The QP of the linear tube by a dual active-set method (Goldfarb and Idnani 1983, Math. Program. 27; in these coordinates
   Arnstroem, Bemporad and Axehill 2022, IEEE Trans. Autom. Control 67(8)): its Hessian H = U U' is a number of the library,
   so that with y = U' w and T = U^-1 it is

     minimise   0.5 |y|^2 + (T g)' y + penalty slack + 0.5 penalty_square slack^2,     (T a)' y - slack <= b

   The multipliers of the active limits solve a linear system as large as there are active limits. One that becomes negative
   is let go; that of a soft limit beyond the penalty lets the limit be passed. Then the limit that is missed most is added,
   until none is: unlike an interior point method cut off, it ends at the solution, in float as in double. It begins at the
   limits that were active in the plan before, one stage on; any multipliers that are not negative are a beginning. */

#include <float.h>

enum { ALL = N * NU, RATES = ALL, SOFTS = 2 * ALL, ROWS = N * NL, ACTIVE = ALL + NU };

typedef struct {
  tube_real soft[ROWS][ALL], size[ROWS], c[ROWS]; /* T a of the soft limits, its square, their values at no command */
  tube_real g[ALL], w[N][NU];         /* gradient at no command; the answer */
  tube_real v[ALL], y[ALL];           /* T g; of the answer */
  int active;
  int row[ACTIVE], side[ACTIVE], passed[ACTIVE]; /* passed: a soft limit, by its slack */
  int held[SOFTS + ROWS];                        /* side at which a limit is active, or 0 */
  tube_real a[ACTIVE][ALL], asks[ACTIVE]; /* T a, and by how much the answer without limits misses them */
  tube_real of[ACTIVE], aim[ACTIVE];      /* multipliers, and what they move to */
  tube_real gram[ACTIVE][ACTIVE], L[ACTIVE][ACTIVE];
} qp_solver;

static const tube_real inverse_root[ALL][ALL] = TUBE_INVERSE_ROOT; /* T, above the diagonal */
static const tube_real hard_size[SOFTS] = TUBE_SIZES;                  /* |T a| of limits of commands and rates */
static const tube_real least_size = 0.1;                          /* of soft limits that hardly feel a command */

static tube_real qp_dot(const tube_real *a, const tube_real *b, int n) {
  tube_real sum = 0;
  UNROLLED
  for (int i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* Stage whose command is the last that a limit feels; rows: limits of commands, of their rates, soft ones. */
static int qp_last(int row) { return row < SOFTS ? row % ALL / NU : (row - SOFTS) / NL; }

/* T a of a limit */
static void qp_row(const qp_solver *s, int row, tube_real side, tube_real out[ALL]) {
  int at = row % ALL, known = (qp_last(row) + 1) * NU;
  for (int i = 0; i < ALL; i++) {
    tube_real v = 0;
    if (i < known && row >= SOFTS)
      v = s->soft[row - SOFTS][i];
    else if (i < known)
      v = inverse_root[i][at] - (row >= RATES ? inverse_root[i][at - NU] : 0);
    out[i] = side * v;
  }
}

/* b of a limit */
static tube_real qp_bound(const qp_solver *s, const tube_qp *q, int row, int side) {
  int k = qp_last(row), j = row % NU;
  if (row >= SOFTS) return q->most[k + 1][(row - SOFTS) % NL] - s->c[row - SOFTS];
  if (row >= RATES) return q->rate_max[j];
  return side > 0 ? q->upper[k][j] : -q->lower[k][j];
}

/* By how much limits give way to their multipliers, beside the slack: limits that say the same leave a factor. */
static tube_real qp_softest(const qp_solver *s, int i) {
  return 32 * (tube_real)FLT_EPSILON * s->gram[i][i] + (s->row[i] >= SOFTS ? (tube_real)FLT_EPSILON : 0);
}

/* L L' = gram + what limits give way, from a row on. Returns 1 where a pivot is not positive. */
static int qp_factorised(qp_solver *s, const tube_qp *q, int from) {
  for (int i = from; i < s->active; i++) {
    tube_real *L = s->L[i], pivot;
    for (int j = 0; j < i; j++) L[j] = (s->gram[i][j] - qp_dot(L, s->L[j], j)) * s->L[j][j];
    pivot = s->gram[i][i] + qp_softest(s, i) - qp_dot(L, L, i);
    if (s->passed[i]) pivot += 1 / q->penalty_square;
    if (!(pivot > 0)) return 1;
    L[i] = 1 / sqrt(pivot); /* of the diagonal there is the inverse */
  }
  return 0;
}

/* x = (L L')^-1 x */
static void qp_backward(const qp_solver *s, tube_real *x) {
  for (int i = 0; i < s->active; i++) x[i] = (x[i] - qp_dot(s->L[i], x, i)) * s->L[i][i];
  for (int i = s->active - 1; i >= 0; i--) {
    const tube_real by = x[i] *= s->L[i][i];
    UNROLLED
    for (int m = 0; m < i; m++) x[m] -= s->L[i][m] * by;
  }
}

/* The multipliers at which the active limits are met */
static void qp_aimed(qp_solver *s, const tube_qp *q) {
  for (int i = 0; i < s->active; i++) s->aim[i] = s->asks[i] + (s->passed[i] ? q->penalty / q->penalty_square : 0);
  qp_backward(s, s->aim);
}

/* once more, for what the factor's softness and rounding left. */
static void qp_refined(qp_solver *s, const tube_qp *q) {
  tube_real left[ACTIVE];
  for (int i = 0; i < s->active; i++) {
    left[i] = s->asks[i] - qp_dot(s->gram[i], s->aim, i + 1);
    for (int j = i + 1; j < s->active; j++) left[i] -= s->gram[j][i] * s->aim[j];
    if (s->passed[i]) left[i] += (q->penalty - s->aim[i]) / q->penalty_square;
  }
  qp_backward(s, left);
  for (int i = 0; i < s->active; i++) s->aim[i] += left[i];
}

static void qp_added(qp_solver *s, const tube_qp *q, int row, int side, int passed, tube_real of) {
  int n = s->active++;
  s->row[n] = row;
  s->side[n] = side;
  s->passed[n] = passed;
  s->held[row] = side;
  s->of[n] = of;
  qp_row(s, row, (tube_real)side, s->a[n]);
  s->asks[n] = -qp_bound(s, q, row, side) - qp_dot(s->a[n], s->v, ALL);
  for (int i = 0; i <= n; i++) s->gram[n][i] = qp_dot(s->a[n], s->a[i], ALL);
}

static void qp_let_go(qp_solver *s, int at) {
  s->held[s->row[at]] = 0;
  for (int i = at; i + 1 < s->active; i++) {
    s->row[i] = s->row[i + 1];
    s->side[i] = s->side[i + 1];
    s->passed[i] = s->passed[i + 1];
    s->asks[i] = s->asks[i + 1];
    s->of[i] = s->of[i + 1];
    memcpy(s->a[i], s->a[i + 1], sizeof s->a[i]);
    for (int j = 0; j <= i; j++) s->gram[i][j] = s->gram[i + 1][j + (j >= at)];
  }
  s->active--;
}

/* Moves the multipliers to what is aimed at, or until the first of them asks for another set of limits: that one's place,
   else -1. */
static int qp_blocked(qp_solver *s, const tube_qp *q) {
  tube_real share = 1, end_at = 0;
  int at = -1;
  for (int i = 0; i < s->active; i++) {
    tube_real from = s->of[i], to = s->aim[i], end = s->passed[i] ? q->penalty : 0, most;
    if (s->row[i] >= SOFTS && !s->passed[i] && to > q->penalty)
      end = q->penalty;
    else if (!(to < end))
      continue;
    most = from == to ? 0 : clip((end - from) / (to - from), 0, 1);
    if (at >= 0 && !(most < share)) continue;
    share = most;
    end_at = end;
    at = i;
  }
  for (int i = 0; i < s->active; i++) s->of[i] = fmax(0, s->of[i] + share * (s->aim[i] - s->of[i]));
  if (at >= 0) s->of[at] = end_at;
  return at;
}

/* y and w of the multipliers */
static void qp_answered(qp_solver *s) {
  tube_real *w = s->w[0];
  for (int i = 0; i < ALL; i++) s->y[i] = -s->v[i];
  for (int m = 0; m < s->active; m++) {
    UNROLLED
    for (int i = 0; i < ALL; i++) s->y[i] -= s->of[m] * s->a[m][i];
  }
  memset(s->w, 0, sizeof s->w);
  for (int i = 0; i < ALL; i++) {
    UNROLLED
    for (int j = i; j < ALL; j++) w[j] += inverse_root[i][j] * s->y[i];
  }
}

/* A limit, and the multiplier that it would take by itself */
typedef struct {
  int row, side;
  tube_real by, tolerance;
} qp_worst;

/* missed: by how much; size: |T a|. An active limit gives way as far as it may. */
static void qp_compared(const qp_solver *s, qp_worst *worst, int row, int side, tube_real missed, tube_real size) {
  tube_real square = size * size;
  if (!(missed > worst->tolerance * size) || !(missed > worst->by * square) || s->held[row] == side) return;
  worst->by = missed / square;
  worst->row = row;
  worst->side = side;
}

/* Of the limits that the answer misses the one whose multiplier would be largest. */
static qp_worst qp_missed(const qp_solver *s, const tube_qp *q, tube_real tolerance) {
  qp_worst worst = {-1, 1, 0, tolerance};
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      int row = k * NU + j;
      tube_real w = s->w[k][j], rate = k > 0 ? w - s->w[k - 1][j] : 0;
      if (w > q->upper[k][j]) qp_compared(s, &worst, row, 1, w - q->upper[k][j], hard_size[row]);
      if (w < q->lower[k][j]) qp_compared(s, &worst, row, -1, q->lower[k][j] - w, hard_size[row]);
      if (fabs(rate) > q->rate_max[j])
        qp_compared(s, &worst, RATES + row, rate > 0 ? 1 : -1, fabs(rate) - q->rate_max[j], hard_size[RATES + row]);
    }
  for (int r = 0; r < ROWS; r++) {
    int k = r / NL + 1;
    tube_real missed = qp_dot(s->soft[r], s->y, k * NU) + s->c[r] - q->most[k][r % NL];
    if (missed > 0) qp_compared(s, &worst, SOFTS + r, 1, missed, sqrt(s->size[r]) + least_size);
  }
  return worst;
}

/* The limits that were active `stages` stages before this plan begins, one plan ago. */
static void qp_shifted(qp_solver *s, const tube_qp *q, int stages) {
  int n = s->active;
  s->active = 0;
  memset(s->held, 0, sizeof s->held);
  for (int i = 0; i < n; i++) {
    int soft = s->row[i] >= SOFTS, row = s->row[i] - stages * (soft ? NL : NU);
    int first = soft ? SOFTS : s->row[i] >= RATES ? RATES + NU : 0;
    if (row >= first) qp_added(s, q, row, s->side[i], s->passed[i], s->of[i]);
  }
}

/* Whether all soft limits are numbers: one that is not would bind nothing. */
static int qp_sound(const qp_solver *s, const tube_qp *q) {
  for (int r = 0; r < ROWS; r++) {
    tube_real left = s->c[r] - q->most[r / NL + 1][r % NL] + s->size[r];
    if (left != left) return 0;
  }
  return 1;
}

/* Iterates from the limits that were active `stages` stages ago: 0 solved, 1 cut off after `most` systems, 2 a factor broke
   down, 3 NaN. */
static int qp_iterated(qp_solver *s, const tube_qp *q, int stages, tube_real tolerance, int most, int *iterations) {
  int from = 0;
  *iterations = 0;
  if (!qp_sound(s, q)) return 3;
  for (int i = 0; i < ALL; i++) s->v[i] = qp_dot(inverse_root[i] + i, s->g + i, ALL - i);
  qp_shifted(s, q, stages);
  for (*iterations = 1;; ++*iterations) {
    int at;
    if (qp_factorised(s, q, from)) return 2;
    qp_aimed(s, q);
    at = qp_blocked(s, q);
    if (at < 0) {
      qp_refined(s, q);
      at = qp_blocked(s, q);
    }
    if (at < 0 || *iterations >= most) {
      qp_worst worst;
      qp_answered(s);
      if (!(largest(s->w[0], ALL) < (tube_real)INFINITY)) return 3;
      worst = qp_missed(s, q, tolerance);
      if (at < 0 && worst.row < 0) return 0;
      if (*iterations >= most || s->active == ACTIVE) return 1;
      from = s->active;
      qp_added(s, q, worst.row, worst.side, 0, 0);
    } else {
      from = at;
      if (s->of[at] > 0 || s->passed[at])
        s->passed[at] = !s->passed[at];
      else
        qp_let_go(s, at);
    }
  }
}
