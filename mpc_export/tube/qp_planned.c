/* The QP of a plan, without a library: its dynamics, the interior point method, its answer. qp_prepared of the file that is
   included there makes ready for a QP. */

/* d from w by the dynamics; with b, or of a change without it. */
static void qp_flown(const tube_qp *q, int moved, tube_real w[N][NU], tube_real d[N + 1][NK]) {
  memset(d[0], 0, sizeof d[0]);
  for (int k = 0; k < N; k++) {
    for (int i = 0; i < NK; i++) d[k + 1][i] = moved ? 0 : q->b[k][i];
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NK; i++) d[k + 1][i] += q->B[k][j * NK + i] * w[k][j];
    if (k > 0) plus_sparse(plan_column, plan_row, q->A[k], NK, d[k], d[k + 1]);
  }
}

#include "qp_interior.c"

static void qp_renew(qp_solver *s) { memset(&s->now, 0, sizeof s->now); }

#ifdef TUBE_HOSTED
static int qp_create(qp_solver *s) {
  qp_renew(s);
  return 0;
}

static void qp_free(qp_solver *s) { (void)s; }
#endif

static void qp_answered(qp_solver *s, const tube_qp *q, tube_qp_answer *answer) {
  qp_flown(q, 0, s->w, answer->d);
  memcpy(answer->w, s->w, sizeof answer->w);
  answer->residual = 0;
  for (int k = 0; k <= N; k++)
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real beyond = s->value[k][i] - s->room[k][i];
      if (i >= SOFT)
        answer->slack[k][i - SOFT] = beyond < 0 ? 0 : beyond;
      else if (!(beyond <= 0))
        answer->residual = larger(answer->residual, beyond);
    }
}

/* Solves the QP, or is cut off: the commands fly by the dynamics, and the residual says how far they are from their limits.
   It always begins anew (`warm` is HPIPM's): in float the end of a QP before is too near its limits. */
static void qp_solve(qp_solver *s, tube_qp *q, tube_real tolerance, int most, int warm, tube_qp_answer *answer) {
  (void)warm;
  qp_prepared(&s->steps, q);
  answer->status = qp_iterated(s, q, tolerance, most, &answer->iterations);
  qp_answered(s, q, answer);
}

/* KKT residual of the plan that the QP is about, with the multipliers of the QP before. */
static tube_real qp_kkt(qp_solver *s, tube_qp *q) {
  qp_distance far;
  tube_real defect = largest(&q->b[0][0], N * NK);
  qp_prepared(&s->steps, q);
  memset(s->w, 0, sizeof s->w);
  qp_rooms(s, q);
  qp_values(s, q, 0, s->w, s->value);
  far = qp_judged(s, q);
  return larger(larger(far.missed, far.slope), larger(far.product, defect));
}
