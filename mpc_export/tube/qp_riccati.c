/* Steps of the interior point method by Riccati recursions (Rao, Wright and Rawlings 1998, J. Optim. Theory Appl. 99(3)):
   for long horizons, whose work and memory grow by the stage. */

/* y += a x of n numbers, n known to the compiler: most of a step's time */
#ifdef __GNUC__
#define PLUS(y, a, x, n) do { \
    _Pragma("GCC unroll 32") \
    for (int plus = 0; plus < (n); plus++) (y)[plus] += (a) * (x)[plus]; \
  } while (0)
#else
#define PLUS(y, a, x, n) for (int plus = 0; plus < (n); plus++) (y)[plus] += (a) * (x)[plus]
#endif

typedef struct {
  tube_real d[N + 1][NK], change_d[N + 1][NK];
  tube_real on_d[N + 1][NK], on_v[N][NU], on_w[N][NU]; /* gradient of the Lagrangian without the dynamics */
  tube_real K[N][(NK + NU) * NU], S[N][NU * NU];       /* feedback on (d, v), Cholesky factor */
  tube_real P[NK * NK], Pv[NK * NU], Pvv[NU * NU], F[NK * NK], E[NK * NU], M[NK * NU];
} qp_steps;

static const tube_real nothing[NU] = {0};
static const tube_real *qp_before(tube_real w[N][NU], int k) { return k > 0 ? w[k - 1] : nothing; }

/* There is nothing to be prepared. */
static void qp_prepared(qp_steps *s, const tube_qp *q) {
  (void)s;
  (void)q;
}

/* Not known here, where no matrix is of the commands: little. */
static tube_real qp_moves(const qp_steps *s, int k, int l) {
  (void)s;
  (void)k;
  (void)l;
  return sqrt(ROUNDING);
}

/* Values of the soft limits, stage by stage; moved: of a change. The states stay in d or change_d. */
static void qp_soft(qp_steps *s, const tube_qp *q, int moved, tube_real w[N][NU], qp_limits value) {
  tube_real (*d)[NK] = moved ? s->change_d : s->d;
  qp_flown(q, moved, w, d);
  for (int k = 1; k <= N; k++) {
    for (int j = 0; j < NL; j++) value[k][SOFT + j] = 0;
    for (int i = 0; i < NK; i++)
      for (int j = 0; j < NL; j++) value[k][SOFT + j] += q->G[k][i * NL + j] * d[k][i];
  }
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

static tube_real qp_slope(qp_steps *s, const tube_qp *q, tube_real w[N][NU], qp_limits of) {
  tube_real most = 0, p[NK] = {0}, after[NK];
  for (int k = N; k >= 0; k--) {
    if (k == N) {
      memcpy(s->on_d[N], q->g_end, sizeof q->g_end);
      for (int j = 0; j < NK; j++)
        for (int i = 0; i < NK; i++) s->on_d[N][i] += q->H_end[j * NK + i] * s->d[N][j];
    } else {
      tube_real y[NV], g[NV];
      memcpy(y, s->d[k], sizeof s->d[k]);
      memcpy(y + NK, qp_before(w, k), sizeof nothing);
      memcpy(y + NZ, w[k], sizeof nothing);
      memcpy(g, q->g[k], sizeof g);
      for (int j = 0; j < NV; j++) {
        if (y[j] == 0) continue;
        for (int i = 0; i < NV; i++) g[i] += q->H[k][j * NV + i] * y[j];
      }
      memcpy(s->on_d[k], g, sizeof s->on_d[k]);
      memcpy(s->on_v[k], g + NK, sizeof nothing);
      memcpy(s->on_w[k], g + NZ, sizeof nothing);
    }
    qp_pushed(q, k, of[k], s->on_d[k], s->on_v[k < N ? k : 0], s->on_w[k < N ? k : 0]);
    /* the slope in w_k alone: with multipliers of the dynamics, backward */
    if (k < N)
      for (int j = 0; j < NU; j++) {
        tube_real slope = s->on_w[k][j] + (k + 1 < N ? s->on_v[k + 1][j] : 0);
        for (int i = 0; i < NK; i++) slope += q->B[k][j * NK + i] * p[i];
        most = larger(most, fabs(slope));
      }
    for (int j = 0; k > 0 && j < NK; j++) {
      after[j] = s->on_d[k][j];
      for (int i = plan_column[j]; k < N && i < plan_column[j + 1]; i++) after[j] += q->A[k][i] * p[plan_row[i]];
    }
    memcpy(p, after, sizeof p);
  }
  return most;
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
static void qp_products(qp_steps *s, const tube_qp *q, int k) {
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

/* Riccati recursion: the cost to go 0.5 (d, v)' [P Pv; Pv' Pvv] (d, v), feedback and factors. Returns 1 where it breaks
   down. */
static int qp_factorised(qp_steps *s, const tube_qp *q, qp_limits weights) {
  memcpy(s->P, q->H_end, sizeof s->P);
  memset(s->Pv, 0, sizeof s->Pv);
  memset(s->Pvv, 0, sizeof s->Pvv);
  qp_weighed(q, weights[N], N, s->P);
  for (int k = N - 1; k >= 0; k--) {
    const tube_real *H = q->H[k], *weight = weights[k];
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

static void qp_stepped(qp_steps *s, const tube_qp *q, qp_limits push, tube_real change_w[N][NU]) {
  tube_real p[NK] = {0}, pv[NU] = {0}, after[NK];
  for (int k = N; k >= 0; k--) {
    tube_real on_d[NK], on_v[NU], on_w[NU] = {0};
    memcpy(on_d, s->on_d[k], sizeof on_d);
    if (k < N) {
      memcpy(on_v, s->on_v[k], sizeof on_v);
      memcpy(on_w, s->on_w[k], sizeof on_w);
    }
    qp_pushed(q, k, push[k], on_d, on_v, on_w);
    if (k < N) {
      tube_real *change = change_w[k];
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
    const tube_real *v = qp_before(change_w, k);
    tube_real *next = s->change_d[k + 1];
    for (int m = 0; k > 0 && m < NU; m++) {
      for (int i = 0; i < NK; i++) change_w[k][m] += s->K[k][i * NU + m] * s->change_d[k][i];
      for (int i = 0; i < NU; i++) change_w[k][m] += s->K[k][(NK + i) * NU + m] * v[i];
    }
    memset(next, 0, sizeof s->change_d[0]);
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NK; i++) next[i] += q->B[k][j * NK + i] * change_w[k][j];
    if (k > 0) plus_sparse(plan_column, plan_row, q->A[k], NK, s->change_d[k], next);
  }
}
