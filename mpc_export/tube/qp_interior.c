/* The QP by a primal-dual interior point method (Mehrotra 1992, SIAM J. Optim. 2(4)), for a craft: static memory, no
   library, and precise enough in float.

   The commands w are the unknowns; d follows from them by the dynamics, which hold at every iterate. A limit a' y <= h has a
   distance t and a multiplier; a soft one may be passed by its slack s, eliminated by hand. An iteration solves for the
   change of w and so corrects what the one before was rounded to. How it is solved for is of the file that is included. */

#include <float.h>

#define ROUNDING (sizeof(tube_real) == sizeof(float) ? FLT_EPSILON : (tube_real)DBL_EPSILON)

enum { UP, DOWN = NU, RISE = 2 * NU, FALL = 3 * NU, SOFT = 4 * NU, LIMITS = 4 * NU + NL };
typedef tube_real qp_limits[N + 1][LIMITS]; /* a number of every limit */

static int qp_first(int k) { return k < N ? 0 : SOFT; }
static int qp_last(int k) { return k > 0 ? LIMITS : RISE; }

/* qp_steps, its memory, and what it does: qp_soft, values G d of the soft limits; qp_moves, how far a unit of the cost moves
   one of them, squared;
   qp_slope, the gradient of the Lagrangian in the commands, of which it returns the largest; qp_factorised; qp_stepped, the
   change of the commands that `push` on the limits asks for. */
#include "qp_steps.c"

typedef struct {
  qp_limits t, of;                         /* distances and multipliers */
  tube_real s[N + 1][NL], of_s[N + 1][NL]; /* slacks and theirs */
} qp_point;

typedef struct {
  qp_point now, move;
  qp_limits room, value, weight, push; /* weight, push: of the limits in the Hessian, in the gradient */
  qp_limits left;                      /* by how much t is not what it says */
  tube_real softest[N + 1][NL];        /* of the soft limits in the Hessian */
  tube_real w[N][NU], change[N][NU];
  qp_steps steps;
} qp_solver;

/* a' y of every limit; moved: of a change */
static void qp_values(qp_solver *s, const tube_qp *q, int moved, tube_real w[N][NU], qp_limits value) {
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      tube_real more = k > 0 ? w[k][j] - w[k - 1][j] : 0;
      value[k][UP + j] = w[k][j];
      value[k][DOWN + j] = -w[k][j];
      value[k][RISE + j] = more;
      value[k][FALL + j] = -more;
    }
  qp_soft(&s->steps, q, moved, w, value);
}

/* h of every limit. Where the limits of a command leave less than a millionth, they are drawn apart: who takes the plan
   over clips its commands. */
static void qp_rooms(qp_solver *s, const tube_qp *q) {
  for (int k = 0; k <= N; k++) {
    tube_real *h = s->room[k];
    for (int j = 0; k < N && j < NU; j++) {
      tube_real middle = 0.5 * (q->upper[k][j] + q->lower[k][j]), half = 0.5 * (q->upper[k][j] - q->lower[k][j]);
      tube_real least = 1e-3 * q->rate_max[j];
      if (half < least) half = least;
      h[UP + j] = half + middle;
      h[DOWN + j] = half - middle;
      h[RISE + j] = q->rate_max[j] - q->change[k][j];
      h[FALL + j] = q->rate_max[j] + q->change[k][j];
    }
    for (int j = 0; k > 0 && j < NL; j++) h[SOFT + j] = q->most[k][j];
  }
}

/* Where the iterations begin: the plan's own commands, inside their limits. */
static void qp_begin(qp_solver *s, const tube_qp *q) {
  const tube_real barrier = 0.1, penalty = q->penalty < 1e-6 ? 1e-6 : q->penalty;
  qp_point *p = &s->now;
  qp_rooms(s, q);
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      const tube_real *h = s->room[k];
      tube_real inside = 0.1 * (h[UP + j] + h[DOWN + j]), w = 0;
      if (w > h[UP + j] - inside) w = h[UP + j] - inside;
      if (w < inside - h[DOWN + j]) w = inside - h[DOWN + j];
      s->w[k][j] = w;
    }
  for (int k = 1; k <= N; k++)
    for (int j = 0; j < NL; j++) s->softest[k][j] = sqrt(ROUNDING) * (ROUNDING * ROUNDING + qp_moves(&s->steps, k, j));
  qp_values(s, q, 0, s->w, s->value);
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real t = s->room[k][i] - s->value[k][i], least = i < SOFT ? 0.1 * q->rate_max[i % NU] : 0.01;
      if (i >= SOFT) {
        tube_real slack = barrier / penalty;
        if (t + slack < least) slack = least - t;
        p->s[k][i - SOFT] = slack;
        t += slack;
      }
      if (t < least) t = least;
      p->t[k][i] = t;
      p->of[k][i] = barrier / t;
      if (i >= SOFT) {
        if (p->of[k][i] > 0.5 * penalty) p->of[k][i] = 0.5 * penalty;
        p->of_s[k][i - SOFT] = penalty + q->penalty_square * p->s[k][i - SOFT] - p->of[k][i];
      }
    }
}

/* What limits miss, and how far from a solution it all is: the largest of what is missed, the mean of the products of
   distances and multipliers, the slope that is left. */
typedef struct {
  tube_real missed, product, slope;
  int pairs;
} qp_distance;

/* s->value is that of s->w. */
static qp_distance qp_judged(qp_solver *s, const tube_qp *q) {
  qp_distance far = {0, 0, 0, 0};
  const qp_point *n = &s->now;
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real left = s->room[k][i] - s->value[k][i] - n->t[k][i];
      far.product += n->t[k][i] * n->of[k][i];
      far.pairs++;
      if (i >= SOFT) {
        int j = i - SOFT;
        left += n->s[k][j];
        far.product += n->s[k][j] * n->of_s[k][j];
        far.pairs++;
      }
      s->left[k][i] = left;
      far.missed = larger(far.missed, fabs(left));
    }
  far.slope = qp_slope(&s->steps, q, s->w, s->now.of);
  far.product /= (tube_real)far.pairs;
  return far;
}

/* Of every limit in the Hessian. They stay finite: a limit is soft by half the digits of what commands move of it. With
   fewer digits the first plans beside a wall hardly converge, with more than of them no limit is met of the positions
   that commands hardly move, those at the beginning of a horizon. */
static void qp_weights(qp_solver *s, const tube_qp *q) {
  const qp_point *n = &s->now;
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      int j = i - SOFT;
      tube_real softest = j < 0 ? ROUNDING : s->softest[k][j];
      tube_real soft = j < 0 ? 0 : n->s[k][j] / (n->of_s[k][j] + q->penalty_square * n->s[k][j]);
      s->weight[k][i] = 1 / (n->t[k][i] / n->of[k][i] + soft + softest);
    }
}

/* What the products of distance and multiplier are moved to: barrier, less what a step before bends them by. */
static tube_real qp_wanted(tube_real t, tube_real of, tube_real barrier, int corrected, tube_real dt, tube_real of_dt) {
  return barrier - t * of - (corrected ? dt * of_dt : 0);
}

/* The change of everything toward products of `barrier`. corrected: s->move holds the step that is corrected. */
static void qp_directed(qp_solver *s, const tube_qp *q, tube_real barrier, int corrected) {
  const qp_point *n = &s->now;
  qp_point *m = &s->move;
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real to = qp_wanted(n->t[k][i], n->of[k][i], barrier, corrected, m->t[k][i], m->of[k][i]), by = to / n->of[k][i];
      m->t[k][i] = to;
      if (i >= SOFT) {
        int j = i - SOFT;
        m->s[k][j] = qp_wanted(n->s[k][j], n->of_s[k][j], barrier, corrected, m->s[k][j], m->of_s[k][j]);
        by -= m->s[k][j] / (n->of_s[k][j] + q->penalty_square * n->s[k][j]);
      }
      s->push[k][i] = s->weight[k][i] * (by - s->left[k][i]);
    }
  qp_stepped(&s->steps, q, s->push, s->change);
  qp_values(s, q, 1, s->change, s->value);
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real of = s->weight[k][i] * s->value[k][i] + s->push[k][i];
      m->of[k][i] = of;
      m->t[k][i] = (m->t[k][i] - n->t[k][i] * of) / n->of[k][i];
      if (i >= SOFT) {
        int j = i - SOFT;
        m->s[k][j] = (m->s[k][j] + n->s[k][j] * of) / (n->of_s[k][j] + q->penalty_square * n->s[k][j]);
        m->of_s[k][j] = q->penalty_square * m->s[k][j] - of;
      }
    }
}

/* The longest step that leaves v and its change m positive, at most `most` */
static tube_real qp_shorter(tube_real most, tube_real v, tube_real m) { return m < 0 && -v > most * m ? -v / m : most; }

/* The longest step that leaves everything positive, at most 1. */
static tube_real qp_length(const qp_solver *s) {
  const qp_point *n = &s->now, *m = &s->move;
  tube_real most = 1;
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      int j = i - SOFT;
      most = qp_shorter(most, n->t[k][i], m->t[k][i]);
      most = qp_shorter(most, n->of[k][i], m->of[k][i]);
      if (j < 0) continue;
      most = qp_shorter(most, n->s[k][j], m->s[k][j]);
      most = qp_shorter(most, n->of_s[k][j], m->of_s[k][j]);
    }
  return most;
}

/* The mean product after a step of this length. */
static tube_real qp_product(const qp_solver *s, tube_real most) {
  const qp_point *n = &s->now, *m = &s->move;
  tube_real sum = 0;
  int pairs = 0;
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      int j = i - SOFT;
      sum += (n->t[k][i] + most * m->t[k][i]) * (n->of[k][i] + most * m->of[k][i]);
      pairs++;
      if (j < 0) continue;
      sum += (n->s[k][j] + most * m->s[k][j]) * (n->of_s[k][j] + most * m->of_s[k][j]);
      pairs++;
    }
  return sum / (tube_real)pairs;
}

static void qp_moved(qp_solver *s, const tube_qp *q, tube_real by) {
  qp_point *n = &s->now, *m = &s->move;
  for (int k = 0; k <= N; k++) {
    for (int j = 0; k < N && j < NU; j++) s->w[k][j] += by * s->change[k][j];
    for (int i = qp_first(k); i < qp_last(k); i++) {
      n->t[k][i] += by * m->t[k][i];
      n->of[k][i] += by * m->of[k][i];
      if (i < SOFT) continue;
      n->s[k][i - SOFT] += by * m->s[k][i - SOFT];
      n->of_s[k][i - SOFT] += by * m->of_s[k][i - SOFT];
    }
  }
  qp_values(s, q, 0, s->w, s->value);
}

/* Whether what is left moves no command by more than the tolerance; begun: the slope of the beginning. What a limit is
   missed by moves commands as it is, a product by its root: so it falls as far in float, which holds it as well, as in
   double. A slope moves them by its part of the curvature; it is a sum that rounds as its parts do, which are as large as at
   the beginning. */
static int qp_solved(const qp_distance *far, tube_real tolerance, tube_real begun) {
  const tube_real least = 1e-6;
  return far->missed <= 0.1 * tolerance && far->product <= 0.001 * (tolerance < least ? tolerance : least) &&
         far->slope <= tolerance + 16 * ROUNDING * begun;
}

/* Iterates from the beginning until the QP is solved to `tolerance`, or `most` times: 0 solved, 1 cut off, 2 a factor or the
   step broke down, which float does near the limits, 3 NaN. The commands found so far are the answer, and s->value is
   theirs. */
static int qp_iterated(qp_solver *s, const tube_qp *q, tube_real tolerance, int most, int *iterations) {
  tube_real begun = 0;
  qp_begin(s, q);
  for (*iterations = 0;; ++*iterations) {
    tube_real aimed, length;
    qp_distance far = qp_judged(s, q);
    if (!(far.missed < (tube_real)INFINITY) || !(far.slope < (tube_real)INFINITY) || !(far.product < (tube_real)INFINITY))
      return 3;
    if (*iterations == 0) begun = far.slope;
    if (qp_solved(&far, tolerance, begun)) return 0;
    if (*iterations >= most) return 1;
    qp_weights(s, q);
    if (qp_factorised(&s->steps, q, s->weight)) return 2;
    qp_directed(s, q, 0, 0);
    aimed = qp_product(s, qp_length(s)) / far.product;
    aimed = far.product * aimed * aimed * aimed;
    qp_directed(s, q, aimed, 1);
    length = 0.995 * qp_length(s);
    if (length < 1e-6) {
      qp_values(s, q, 0, s->w, s->value);
      return 2;
    }
    qp_moved(s, q, length);
  }
}
