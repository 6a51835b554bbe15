/* The QP by a primal-dual interior point method whose steps are Riccati recursions (Mehrotra 1992, SIAM J. Optim. 2(4);
   Rao, Wright and Rawlings 1998, J. Optim. Theory Appl. 99(3)), for a craft: static memory, no library, and precise enough
   in float.

   The commands w are the unknowns; d follows from them by the dynamics, which hold at every iterate. A limit a' y <= h has a
   distance t and a multiplier; a soft one may be passed by its slack s, eliminated by hand. An iteration solves for the
   change of w and so corrects what the one before was rounded to. */

#include <float.h>

enum { UP, DOWN = NU, RISE = 2 * NU, FALL = 3 * NU, SOFT = 4 * NU, LIMITS = 4 * NU + NL };

typedef struct {
  tube_real t[LIMITS], of[LIMITS], s[NL], of_s[NL]; /* distances, slacks, and the multipliers of each */
} qp_point;

typedef struct {
  qp_point now[N + 1], move[N + 1];
  tube_real weight[N + 1][LIMITS], push[N + 1][LIMITS]; /* of the limits: in the Hessian, in the gradient */
  tube_real left[N + 1][LIMITS];                        /* by how much t is not what it says */
  tube_real d[N + 1][NK], w[N][NU], change_d[N + 1][NK], change_w[N][NU];
  tube_real on_d[N + 1][NK], on_v[N][NU], on_w[N][NU]; /* gradient of the Lagrangian without the dynamics */
  tube_real K[N][(NK + NU) * NU], S[N][NU * NU];       /* feedback on (d, v), Cholesky factor */
  tube_real P[NK * NK], Pv[NK * NU], Pvv[NU * NU], F[NK * NK], E[NK * NU], M[NK * NU];
} qp_solver;

static void qp_renew(qp_solver *s) { memset(s->now, 0, sizeof s->now); }

#ifdef TUBE_HOSTED
static int qp_create(qp_solver *s) {
  qp_renew(s);
  return 0;
}

static void qp_free(qp_solver *s) { (void)s; }
#endif

static const tube_real nothing[NU] = {0};
static int qp_first(int k) { return k < N ? 0 : SOFT; }
static int qp_last(int k) { return k > 0 ? LIMITS : RISE; }
static const tube_real *qp_before(tube_real w[N][NU], int k) { return k > 0 ? w[k - 1] : nothing; }

/* a' y of every limit of stage k */
static void qp_values(const tube_qp *q, int k, const tube_real *d, const tube_real *v, const tube_real *w, tube_real *out) {
  for (int j = 0; k < N && j < NU; j++) {
    out[UP + j] = w[j];
    out[DOWN + j] = -w[j];
    out[RISE + j] = w[j] - v[j];
    out[FALL + j] = v[j] - w[j];
  }
  for (int j = 0; k > 0 && j < NL; j++) out[SOFT + j] = 0;
  for (int i = 0; k > 0 && i < NK; i++)
    for (int j = 0; j < NL; j++) out[SOFT + j] += q->G[k][i * NL + j] * d[i];
}

/* The gradients += a c */
static void qp_pushed(const tube_qp *q, int k, const tube_real *c, tube_real *on_d, tube_real *on_v, tube_real *on_w) {
  for (int j = 0; k < N && j < NU; j++) {
    tube_real rate = k > 0 ? c[RISE + j] - c[FALL + j] : 0;
    on_w[j] += c[UP + j] - c[DOWN + j] + rate;
    on_v[j] -= rate;
  }
  for (int i = 0; k > 0 && i < NK; i++)
    for (int j = 0; j < NL; j++) on_d[i] += q->G[k][i * NL + j] * c[SOFT + j];
}

/* h of every limit of stage k. Where the limits of a command leave less than a millionth, they are drawn apart: who takes the plan
   over clips its commands. */
static void qp_room(const tube_qp *q, int k, tube_real *h) {
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

/* Where the iterations begin: the plan's own commands, inside their limits. */
static void qp_begin(qp_solver *s, const tube_qp *q) {
  const tube_real barrier = 0.1, penalty = q->penalty < 1e-6 ? 1e-6 : q->penalty;
  tube_real h[LIMITS], value[LIMITS];
  for (int k = 0; k < N; k++) {
    qp_room(q, k, h);
    for (int j = 0; j < NU; j++) {
      tube_real inside = 0.1 * (h[UP + j] + h[DOWN + j]), w = 0;
      if (w > h[UP + j] - inside) w = h[UP + j] - inside;
      if (w < inside - h[DOWN + j]) w = inside - h[DOWN + j];
      s->w[k][j] = w;
    }
  }
  qp_flown(q, 0, s->w, s->d);
  for (int k = 0; k <= N; k++) {
    qp_point *p = &s->now[k];
    qp_room(q, k, h);
    qp_values(q, k, s->d[k], qp_before(s->w, k), s->w[k < N ? k : 0], value);
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real t = h[i] - value[i], least = i < SOFT ? 0.1 * q->rate_max[i % NU] : 0.01;
      if (i >= SOFT) {
        tube_real slack = barrier / penalty;
        if (t + slack < least) slack = least - t;
        p->s[i - SOFT] = slack;
        t += slack;
      }
      if (t < least) t = least;
      p->t[i] = t;
      p->of[i] = barrier / t;
      if (i >= SOFT) {
        if (p->of[i] > 0.5 * penalty) p->of[i] = 0.5 * penalty;
        p->of_s[i - SOFT] = penalty + q->penalty_square * p->s[i - SOFT] - p->of[i];
      }
    }
  }
}

/* Gradients, what limits miss, and how far from a solution it all is: the largest of what is missed, the mean of the
   products of distances and multipliers, the slope that is left. */
typedef struct {
  tube_real missed, product, slope;
  int pairs;
} qp_distance;

static qp_distance qp_judged(qp_solver *s, const tube_qp *q) {
  qp_distance far = {0, 0, 0, 0};
  tube_real h[LIMITS], value[LIMITS], p[NK] = {0}, after[NK];
  for (int k = N; k >= 0; k--) {
    const tube_real *v = qp_before(s->w, k);
    qp_room(q, k, h);
    qp_values(q, k, s->d[k], v, s->w[k < N ? k : 0], value);
    for (int i = qp_first(k); i < qp_last(k); i++) {
      const qp_point *n = &s->now[k];
      s->left[k][i] = h[i] - value[i] - n->t[i] + (i >= SOFT ? n->s[i - SOFT] : 0);
      far.missed = larger(far.missed, fabs(s->left[k][i]));
      far.product += n->t[i] * n->of[i];
      far.pairs++;
      if (i >= SOFT) {
        far.product += n->s[i - SOFT] * n->of_s[i - SOFT];
        far.pairs++;
      }
    }
    if (k == N) {
      memcpy(s->on_d[N], q->g_end, sizeof q->g_end);
      for (int j = 0; j < NK; j++)
        for (int i = 0; i < NK; i++) s->on_d[N][i] += q->H_end[j * NK + i] * s->d[N][j];
    } else {
      tube_real y[NV], g[NV];
      memcpy(y, s->d[k], sizeof s->d[k]);
      memcpy(y + NK, v, sizeof nothing);
      memcpy(y + NZ, s->w[k], sizeof nothing);
      memcpy(g, q->g[k], sizeof g);
      for (int j = 0; j < NV; j++) {
        if (y[j] == 0) continue;
        for (int i = 0; i < NV; i++) g[i] += q->H[k][j * NV + i] * y[j];
      }
      memcpy(s->on_d[k], g, sizeof s->on_d[k]);
      memcpy(s->on_v[k], g + NK, sizeof nothing);
      memcpy(s->on_w[k], g + NZ, sizeof nothing);
    }
    qp_pushed(q, k, s->now[k].of, s->on_d[k], s->on_v[k < N ? k : 0], s->on_w[k < N ? k : 0]);
    /* the slope in w_k alone: with multipliers of the dynamics, backward */
    if (k < N)
      for (int j = 0; j < NU; j++) {
        tube_real slope = s->on_w[k][j] + (k + 1 < N ? s->on_v[k + 1][j] : 0);
        for (int i = 0; i < NK; i++) slope += q->B[k][j * NK + i] * p[i];
        far.slope = larger(far.slope, fabs(slope));
      }
    for (int j = 0; k > 0 && j < NK; j++) {
      after[j] = s->on_d[k][j];
      for (int i = plan_column[j]; k < N && i < plan_column[j + 1]; i++) after[j] += q->A[k][i] * p[plan_row[i]];
    }
    memcpy(p, after, sizeof p);
  }
  far.product /= (tube_real)far.pairs;
  return far;
}

/* L of S = L L' in place, S (NU x NU). Returns 1 where S is not positive. */
static int qp_cholesky(tube_real *S) {
  for (int j = 0; j < NU; j++) {
    for (int i = j; i < NU; i++) {
      tube_real sum = S[j * NU + i];
      for (int m = 0; m < j; m++) sum -= S[m * NU + i] * S[m * NU + j];
      if (i == j && !(sum > 0)) return 1;
      S[j * NU + i] = i == j ? sqrt(sum) : sum / S[j * NU + j];
    }
  }
  return 0;
}

/* x = -S^-1 x */
static void qp_backward(const tube_real *L, tube_real *x) {
  for (int i = 0; i < NU; i++) {
    for (int m = 0; m < i; m++) x[i] -= L[m * NU + i] * x[m];
    x[i] /= L[i * NU + i];
  }
  for (int i = NU - 1; i >= 0; i--) {
    for (int m = i + 1; m < NU; m++) x[i] -= L[i * NU + m] * x[m];
    x[i] /= L[i * NU + i];
  }
  for (int i = 0; i < NU; i++) x[i] = -x[i];
}

/* P += G' weight G */
static void qp_weighed(const tube_qp *q, const tube_real *weight, int k, tube_real *P) {
  for (int j = 0; j < NL; j++)
    for (int m = 0; m < NK; m++) {
      tube_real by = weight[SOFT + j] * q->G[k][m * NL + j];
      if (by == 0) continue;
      for (int i = 0; i < NK; i++) P[m * NK + i] += by * q->G[k][i * NL + j];
    }
}

/* F = P A, E = P B + Pv: columns */
static void qp_products(qp_solver *s, const tube_qp *q, int k) {
  memset(s->F, 0, sizeof s->F);
  for (int j = 0; k > 0 && j < NK; j++)
    for (int m = plan_column[j]; m < plan_column[j + 1]; m++) {
      const tube_real a = q->A[k][m], *p = s->P + plan_row[m] * NK;
      PLUS(s->F + j * NK, a, p, NK);
    }
  memcpy(s->E, s->Pv, sizeof s->E);
  for (int j = 0; j < NU; j++)
    for (int m = 0; m < NK; m++) {
      const tube_real b = q->B[k][j * NK + m], *p = s->P + m * NK;
      if (b != 0) PLUS(s->E + j * NK, b, p, NK);
    }
}

/* Riccati recursion: the cost to go 0.5 (d, v)' [P Pv; Pv' Pvv] (d, v), feedback and factors. Returns 1 where it breaks down. */
static int qp_factorised(qp_solver *s, const tube_qp *q) {
  memcpy(s->P, q->H_end, sizeof s->P);
  memset(s->Pv, 0, sizeof s->Pv);
  memset(s->Pvv, 0, sizeof s->Pvv);
  qp_weighed(q, s->weight[N], N, s->P);
  for (int k = N - 1; k >= 0; k--) {
    const tube_real *H = q->H[k], *weight = s->weight[k];
    tube_real *S = s->S[k], *K = s->K[k], *Kv = K + NK * NU, Mv[NU * NU];
    qp_products(s, q, k);
    for (int j = 0; j < NU; j++) {
      for (int i = 0; i < NU; i++) {
        tube_real sum = H[(NZ + j) * NV + NZ + i] + s->Pvv[j * NU + i];
        for (int m = 0; m < NK; m++) sum += q->B[k][i * NK + m] * s->E[j * NK + m] + s->Pv[i * NK + m] * q->B[k][j * NK + m];
        S[j * NU + i] = sum;
      }
      S[j * NU + j] += weight[UP + j] + weight[DOWN + j] + (k > 0 ? weight[RISE + j] + weight[FALL + j] : 0);
    }
    if (qp_cholesky(S)) return 1;
    if (k == 0) break;
    /* M = E' A + H_wd: (NU x NK), its columns through the factor are the feedback */
    for (int j = 0; j < NK; j++)
      for (int i = 0; i < NU; i++) {
        tube_real sum = H[j * NV + NZ + i];
        for (int m = plan_column[j]; m < plan_column[j + 1]; m++) sum += s->E[i * NK + plan_row[m]] * q->A[k][m];
        s->M[j * NU + i] = K[j * NU + i] = sum;
      }
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NU; i++) {
        tube_real sum = H[(NK + j) * NV + NZ + i];
        if (i == j) sum -= weight[RISE + j] + weight[FALL + j];
        Mv[j * NU + i] = Kv[j * NU + i] = sum;
      }
    for (int j = 0; j < NZ; j++) qp_backward(S, K + j * NU);
    for (int j = 0; j < NK; j++)
      for (int i = 0; i <= j; i++) {
        tube_real sum = H[j * NV + i];
        for (int m = plan_column[i]; m < plan_column[i + 1]; m++) sum += q->A[k][m] * s->F[j * NK + plan_row[m]];
        for (int m = 0; m < NU; m++) sum += s->M[i * NU + m] * K[j * NU + m];
        s->P[j * NK + i] = s->P[i * NK + j] = sum;
      }
    qp_weighed(q, weight, k, s->P);
    for (int j = 0; j < NU; j++) {
      for (int i = 0; i < NK; i++) {
        tube_real sum = H[(NK + j) * NV + i];
        for (int m = 0; m < NU; m++) sum += s->M[i * NU + m] * Kv[j * NU + m];
        s->Pv[j * NK + i] = sum;
      }
      for (int i = 0; i < NU; i++) {
        tube_real sum = H[(NK + j) * NV + NK + i];
        if (i == j) sum += weight[RISE + j] + weight[FALL + j];
        for (int m = 0; m < NU; m++) sum += Mv[i * NU + m] * Kv[j * NU + m];
        s->Pvv[j * NU + i] = sum;
      }
    }
  }
  return 0;
}

/* What the products of distance and multiplier are moved to: barrier, less what a step before bends them by. */
static tube_real qp_wanted(tube_real t, tube_real of, tube_real barrier, int corrected, tube_real dt, tube_real of_dt) {
  return barrier - t * of - (corrected ? dt * of_dt : 0);
}

/* The change of everything toward products of `barrier`. corrected: s->move holds the step that is corrected. */
static void qp_directed(qp_solver *s, const tube_qp *q, tube_real barrier, int corrected) {
  tube_real p[NK] = {0}, pv[NU] = {0}, after[NK], h[LIMITS];
  for (int k = N; k >= 0; k--) {
    const qp_point *n = &s->now[k], *m = &s->move[k];
    tube_real on_d[NK], on_v[NU], on_w[NU] = {0};
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real to = qp_wanted(n->t[i], n->of[i], barrier, corrected, m->t[i], m->of[i]), by = to / n->of[i];
      if (i >= SOFT) {
        int j = i - SOFT;
        tube_real to_s = qp_wanted(n->s[j], n->of_s[j], barrier, corrected, m->s[j], m->of_s[j]);
        by -= to_s / (n->of_s[j] + q->penalty_square * n->s[j]);
      }
      s->push[k][i] = s->weight[k][i] * (by - s->left[k][i]);
    }
    memcpy(on_d, s->on_d[k], sizeof on_d);
    if (k < N) {
      memcpy(on_v, s->on_v[k], sizeof on_v);
      memcpy(on_w, s->on_w[k], sizeof on_w);
    }
    qp_pushed(q, k, s->push[k], on_d, on_v, on_w);
    if (k < N) {
      tube_real *change = s->change_w[k];
      for (int j = 0; j < NU; j++) {
        on_w[j] += pv[j];
        for (int i = 0; i < NK; i++) on_w[j] += q->B[k][j * NK + i] * p[i];
        change[j] = on_w[j];
      }
      qp_backward(s->S[k], change);
      for (int j = 0; k > 0 && j < NU; j++) {
        pv[j] = on_v[j];
        for (int i = 0; i < NU; i++) pv[j] += s->K[k][(NK + j) * NU + i] * on_w[i];
      }
    }
    for (int j = 0; k > 0 && j < NK; j++) {
      after[j] = on_d[j];
      if (k == N) continue;
      for (int i = plan_column[j]; i < plan_column[j + 1]; i++) after[j] += q->A[k][i] * p[plan_row[i]];
      for (int i = 0; i < NU; i++) after[j] += s->K[k][j * NU + i] * on_w[i];
    }
    memcpy(p, after, sizeof p);
  }
  memset(s->change_d[0], 0, sizeof s->change_d[0]);
  for (int k = 0; k < N; k++) {
    const tube_real *v = qp_before(s->change_w, k);
    tube_real *next = s->change_d[k + 1];
    for (int m = 0; k > 0 && m < NU; m++) {
      for (int i = 0; i < NK; i++) s->change_w[k][m] += s->K[k][i * NU + m] * s->change_d[k][i];
      for (int i = 0; i < NU; i++) s->change_w[k][m] += s->K[k][(NK + i) * NU + m] * v[i];
    }
    memset(next, 0, sizeof s->change_d[0]);
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NK; i++) next[i] += q->B[k][j * NK + i] * s->change_w[k][j];
    if (k > 0) plus_sparse(plan_column, plan_row, q->A[k], NK, s->change_d[k], next);
  }
  for (int k = 0; k <= N; k++) {
    const qp_point *n = &s->now[k];
    qp_point *m = &s->move[k];
    qp_values(q, k, s->change_d[k], qp_before(s->change_w, k), s->change_w[k < N ? k : 0], h);
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real to = qp_wanted(n->t[i], n->of[i], barrier, corrected, m->t[i], m->of[i]);
      m->of[i] = s->weight[k][i] * h[i] + s->push[k][i];
      if (i >= SOFT) {
        int j = i - SOFT;
        tube_real to_s = qp_wanted(n->s[j], n->of_s[j], barrier, corrected, m->s[j], m->of_s[j]);
        m->s[j] = (to_s + n->s[j] * m->of[i]) / (n->of_s[j] + q->penalty_square * n->s[j]);
        m->of_s[j] = q->penalty_square * m->s[j] - m->of[i];
      }
      m->t[i] = (to - n->t[i] * m->of[i]) / n->of[i];
    }
  }
}

/* The longest step that leaves everything positive, at most 1, and the mean product after it. */
static tube_real qp_length(const qp_solver *s, tube_real *product) {
  tube_real most = 1, sum = 0;
  int pairs = 0;
  for (int pass = 0; pass < 2; pass++)
    for (int k = 0; k <= N; k++) {
      const qp_point *n = &s->now[k], *m = &s->move[k];
      for (int i = qp_first(k); i < qp_last(k); i++) {
        int j = i - SOFT;
        if (pass == 0) {
          if (m->t[i] < 0 && -n->t[i] > most * m->t[i]) most = -n->t[i] / m->t[i];
          if (m->of[i] < 0 && -n->of[i] > most * m->of[i]) most = -n->of[i] / m->of[i];
          if (j >= 0 && m->s[j] < 0 && -n->s[j] > most * m->s[j]) most = -n->s[j] / m->s[j];
          if (j >= 0 && m->of_s[j] < 0 && -n->of_s[j] > most * m->of_s[j]) most = -n->of_s[j] / m->of_s[j];
          continue;
        }
        sum += (n->t[i] + most * m->t[i]) * (n->of[i] + most * m->of[i]);
        pairs++;
        if (j < 0) continue;
        sum += (n->s[j] + most * m->s[j]) * (n->of_s[j] + most * m->of_s[j]);
        pairs++;
      }
    }
  *product = sum / (tube_real)pairs;
  return most;
}

static void qp_moved(qp_solver *s, const tube_qp *q, tube_real by) {
  for (int k = 0; k <= N; k++) {
    qp_point *n = &s->now[k], *m = &s->move[k];
    for (int j = 0; k < N && j < NU; j++) s->w[k][j] += by * s->change_w[k][j];
    for (int i = qp_first(k); i < qp_last(k); i++) {
      n->t[i] += by * m->t[i];
      n->of[i] += by * m->of[i];
      if (i < SOFT) continue;
      n->s[i - SOFT] += by * m->s[i - SOFT];
      n->of_s[i - SOFT] += by * m->of_s[i - SOFT];
    }
  }
  qp_flown(q, 0, s->w, s->d);
}

static void qp_answered(const qp_solver *s, const tube_qp *q, tube_qp_answer *answer) {
  tube_real h[LIMITS], value[LIMITS];
  memcpy(answer->d, s->d, sizeof answer->d);
  memcpy(answer->w, s->w, sizeof answer->w);
  answer->residual = 0;
  for (int k = 0; k <= N; k++) {
    const tube_real *v = k > 0 ? s->w[k - 1] : nothing;
    qp_room(q, k, h);
    qp_values(q, k, s->d[k], v, s->w[k < N ? k : 0], value);
    for (int i = qp_first(k); i < qp_last(k); i++) {
      tube_real beyond = value[i] - h[i];
      if (i >= SOFT)
        answer->slack[k][i - SOFT] = beyond < 0 ? 0 : beyond;
      else if (!(beyond <= 0))
        answer->residual = larger(answer->residual, beyond);
    }
  }
}

/* Solves the QP. Where a recursion breaks down, which float does near the limits, the commands found so far are the answer: they
   fly by the dynamics, and the residual says how far they are from their limits. It always begins anew (`warm` is HPIPM's): in float the end of a QP before is too near its limits. */
static void qp_solve(qp_solver *s, tube_qp *q, tube_real tolerance, int most, int warm, tube_qp_answer *answer) {
  /* Weights stay finite. Where limits are soft by more, the first plans beside a wall hardly converge: position feels the
     first commands of a horizon by less than a thousandth. */
  const tube_real softest = sizeof(tube_real) == sizeof(float) ? FLT_EPSILON : (tube_real)DBL_EPSILON;
  (void)warm;
  answer->status = 1;
  qp_begin(s, q);
  for (answer->iterations = 0;; answer->iterations++) {
    tube_real product, aimed, length;
    qp_distance far = qp_judged(s, q);
    if (!(far.missed < (tube_real)INFINITY) || !(far.slope < (tube_real)INFINITY) || !(far.product < (tube_real)INFINITY)) answer->status = 3;
    /* What a limit is missed by moves commands as it is, a product by its root, a slope by its part of the curvature, and in float
       it rounds with multipliers as large as the penalty. */
    if (far.missed <= 0.1 * tolerance && far.product <= 0.001 * tolerance && far.slope <= tolerance) answer->status = 0;
    if (answer->status != 1 || answer->iterations >= most) break;
    for (int k = 0; k <= N; k++)
      for (int i = qp_first(k); i < qp_last(k); i++) {
        const qp_point *n = &s->now[k];
        tube_real soft = i < SOFT ? 0 : n->s[i - SOFT] / (n->of_s[i - SOFT] + q->penalty_square * n->s[i - SOFT]);
        s->weight[k][i] = 1 / (n->t[i] / n->of[i] + soft + softest);
      }
    if (qp_factorised(s, q)) {
      answer->status = 2;
      break;
    }
    qp_directed(s, q, 0, 0);
    qp_length(s, &product);
    aimed = product / far.product;
    aimed = far.product * aimed * aimed * aimed;
    qp_directed(s, q, aimed, 1);
    length = 0.995 * qp_length(s, &product);
    if (length < 1e-6) {
      answer->status = 2;
      break;
    }
    qp_moved(s, q, length);
  }
  qp_answered(s, q, answer);
}

/* KKT residual of the plan that the QP is about, with the multipliers of the QP before. */
static tube_real qp_kkt(qp_solver *s, tube_qp *q) {
  qp_distance far;
  tube_real defect = largest(&q->b[0][0], N * NK);
  memset(s->w, 0, sizeof s->w);
  memset(s->d, 0, sizeof s->d);
  far = qp_judged(s, q);
  return larger(larger(far.missed, far.slope), larger(far.product, defect));
}
