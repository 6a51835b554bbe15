/* The linear tube: the model as it is near hover, at any heading, since errors of place and speed stand in body axes. What
   does not change was computed before: the QP's Hessian, what commands move, the tube. linear.py says how. */

static const tube_real transition[ND * ND] = TUBE_TRANSITION, responses[N * (N + 1) / 2 * NK * NU] = TUBE_RESPONSES;
static const tube_real terminal[NK][N * NU] = TUBE_TERMINAL;
static const tube_real felt[N][6][N * NU] = TUBE_FELT; /* responses of place and attitude in the coordinates of the QP */
static const tube_real steady[NK + NU][NFREE1] = TUBE_STEADY, gain[NU][ND] = TUBE_GAIN;
static const tube_real tracking[NK] = TUBE_TRACKING, on_command = TUBE_ON_COMMAND, on_change = TUBE_ON_CHANGE;
static const tube_real place_spread[N + 1][3][3] = TUBE_PLACE_SPREAD, tilt_spread[N + 1][2][2] = TUBE_TILT_SPREAD;
static const tube_real command_spread[N][NU] = TUBE_COMMAND_SPREAD;
static const tube_real level[2] = TUBE_LEVEL; /* hover's own tilt */
/* tilt, speed and rate away from hover, each alone, at which the prediction misses by @trusted@ standard deviations of the
   tube */
static const tube_real trusted[3] = TUBE_TRUSTED;
/* the hover command that all this is made for over that at values of the run-time parameters */
static const tube_real values[NP1][@n_values@] = @values@, ratios[NP1][@n_values@] = @ratios@;
static const int keep[NK] = TUBE_KEEP, pushed_at[NFREE1] = TUBE_PUSHED;
enum { K_POSITION = TUBE_K_POSITION, K_VELOCITY = TUBE_K_VELOCITY, K_ATTITUDE = TUBE_K_ATTITUDE, K_RATE = TUBE_K_RATE };

/* What the command of stage j < k moves the error state of stage k by (NK rows of NU) */
static const tube_real *response(int k, int j) { return responses + ((k - 1) * k / 2 + j) * NK * NU; }

void @NAME@_tube_kappa(const tube_real kappa[NL], tube_real commands) {
  memcpy(c.kappa, kappa, sizeof c.kappa);
  c.kappa_u = commands;
}

int @NAME@_tube_start(const tube_real place[4]) {
  tube_real x[NX];
  if (!all_finite(place, 4)) return 0;
  begin(place, x);
  @NAME@_tube_kappa((const tube_real[NL])@kappa@, @kappa_u@);
  c.qp.penalty = fmax(penalty, 1e-6);
  c.qp.penalty_square = fmax(penalty_square, 1e-3 * c.qp.penalty); /* a slack without a square has no end */
  c.ratio = 1;
  return 1;
}

/* Commands of the plan over the craft's, with the run-time parameters of now. */
static tube_real proportion(void) {
  tube_real product = 1;
  for (int i = 0; i < TOLD; i++) {
    int k = 1;
    while (k + 1 < @n_values@ && c.p[i] > values[i][k]) k++;
    tube_real wide = values[i][k] - values[i][k - 1], share = wide > 0 ? (c.p[i] - values[i][k - 1]) / wide : 0;
    product *= ratios[i][k - 1] + clip(share, 0, 1) * (ratios[i][k] - ratios[i][k - 1]);
  }
  return product;
}

/* Rows of R: axes of the body at attitude q, in the world */
static void axes(const tube_real *q, tube_real R[3][3]) {
  R[0][0] = 1 - 2 * (q[2] * q[2] + q[3] * q[3]);
  R[1][0] = 2 * (q[1] * q[2] - q[0] * q[3]);
  R[2][0] = 2 * (q[1] * q[3] + q[0] * q[2]);
  R[0][1] = 2 * (q[1] * q[2] + q[0] * q[3]);
  R[1][1] = 1 - 2 * (q[1] * q[1] + q[3] * q[3]);
  R[2][1] = 2 * (q[2] * q[3] - q[0] * q[1]);
  R[0][2] = 2 * (q[1] * q[3] - q[0] * q[2]);
  R[1][2] = 2 * (q[2] * q[3] + q[0] * q[1]);
  R[2][2] = 1 - 2 * (q[1] * q[1] + q[2] * q[2]);
}

static void turned_into(tube_real R[3][3], const tube_real *v, tube_real *out) {
  for (int i = 0; i < 3; i++) out[i] = R[i][0] * v[0] + R[i][1] * v[1] + R[i][2] * v[2];
}

/* Error states d of the craft about hover at its heading and the path's place; R: axes of that hover. Returns 1 where it
   fails. */
static int placed(const tube_real *place, tube_real d[ND], tube_real R[3][3]) {
  tube_real x[NX], base[NX], half = 0.5 * heading(c.known.estimate), q[4], w = cos(half), z = sin(half);
  const tube_real *h = hover_x + ATTITUDE;
  planned_from(x);
  for (int i = OWN; i < NX; i++) x[i] *= c.ratio;
  memcpy(base, hover_x, sizeof base);
  memcpy(base + POSITION, place, 3 * sizeof *place);
  q[0] = w * h[0] - z * h[3];
  q[1] = w * h[1] - z * h[2];
  q[2] = w * h[2] + z * h[1];
  q[3] = w * h[3] + z * h[0];
  memcpy(base + ATTITUDE, q, sizeof q);
  axes(q, R);
  const tube_real *arg[TUBE_ARG] = {x, base};
  tube_real *res[TUBE_RES] = {d};
  return @NAME@_tube_model_boxminus(arg, res, c.iw, c.w, 0) || !all_finite(d, ND);
}

/* What the path asks of the error states of stage k. */
static void asked(const @NAME@_tube_path *path, int k, tube_real R[3][3], const tube_real *rest, tube_real goal[NK]) {
  tube_real away[3], yaw = path[k].yaw - heading(c.known.estimate), up[3];
  memcpy(goal, rest, NK * sizeof *goal);
  for (int i = 0; i < 3; i++) away[i] = path[k].position[i] - path[0].position[i];
  turned_into(R, away, goal + K_POSITION);
  turned_into(R, path[k].velocity, goal + K_VELOCITY);
  turned_into(R, path[k].acceleration, up);
  goal[K_ATTITUDE] -= up[1] / (tube_real)9.80665;
  goal[K_ATTITUDE + 1] += up[0] / (tube_real)9.80665;
  goal[K_ATTITUDE + 2] = clip(atan2(sin(yaw), cos(yaw)), -@near_heading@, @near_heading@);
}

/* The soft limits of stage k about the response w to no command, and what the tube takes off them. planes: of the stage. */
static void limited(const tube_real *planes, int k, tube_real R[3][3], const tube_real *origin, tube_real d[NK]) {
  for (int l = 0; l < NL; l++) {
    tube_real normal[3] = {0, 0, 0}, most = @tilt_max@, spread = 0, value = 0, *row = c.solver.soft[(k - 1) * NL + l];
    int at = l < NPL ? K_POSITION : K_ATTITUDE;
    const tube_real(*moved)[N * NU] = felt[k - 1] + (l < NPL ? 0 : 3);
    if (l < NPL) {
      most = 1;
      if (planes) {
        const tube_real *plane = planes + l * 4;
        turned_into(R, plane, normal);
        most = plane[3] - plane[0] * origin[0] - plane[1] * origin[1] - plane[2] * origin[2];
      }
      for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) spread += normal[i] * place_spread[k][i][j] * normal[j];
    } else {
      /* toward where it tilts; nearly level there is none, and no limit near */
      tube_real size = fmax(norm(c.tilt[k], 2), 0.3 * most);
      normal[0] = c.tilt[k][0] / size;
      normal[1] = c.tilt[k][1] / size;
      for (int i = 0; i < 2; i++) {
        value += normal[i] * level[i];
        for (int j = 0; j < 2; j++) spread += normal[i] * tilt_spread[k][i][j] * normal[j];
      }
    }
    for (int j = 0; j < k * NU; j++) row[j] = normal[0] * moved[0][j] + normal[1] * moved[1][j] + normal[2] * moved[2][j];
    for (int i = 0; i < 3; i++) value += normal[i] * d[at + i];
    c.solver.size[(k - 1) * NL + l] = qp_dot(row, row, k * NU);
    c.solver.c[(k - 1) * NL + l] = value;
    c.qp.most[k][l] = most - c.kappa[l] * sqrt(spread > 0 ? spread : 0);
  }
}

/* Limits of the commands of stage k, from hover's command. */
static void bounded(int k, const tube_real *rest) {
  for (int j = 0; j < NU; j++) {
    tube_real u = hover_u[j] + rest[NK + j], least = c.ratio * command_min, most = c.ratio * command_max;
    tube_real low, high, off = c.kappa_u * command_spread[k][j], now = c.ratio * c.u[j], rate = c.ratio * rate_max;
    off = fmax(0, fmin(off, 0.5 * fmin(most - u, u - least)));
    low = least + off;
    high = most - off;
    if (k == 0) {
      /* a command in force beyond the limits goes back as fast as it may */
      low = fmin(fmax(low, now - rate), now + rate);
      high = fmax(fmin(high, now + rate), now - rate);
    }
    c.qp.rate_max[j] = rate;
    c.qp.lower[k][j] = low - hover_u[j];
    c.qp.upper[k][j] = high - hover_u[j];
  }
}

/* g += G' (what stage k is away from its goal, weighed) */
static void drawn(int k, const tube_real *d, const tube_real *goal) {
  tube_real *g = c.solver.g, away[NK];
  for (int i = 0; i < NK; i++) away[i] = d[keep[i]] - goal[i];
  if (k == N) {
    for (int i = 0; i < NK; i++)
      for (int j = 0; j < N * NU; j++) g[j] += away[i] * terminal[i][j];
    return;
  }
  for (int i = 0; i < NK; i++) {
    tube_real pull = tracking[i] * away[i];
    if (pull == 0) continue;
    for (int j = 0; j < k; j++)
      for (int m = 0; m < NU; m++) g[j * NU + m] += pull * response(k, j)[i * NU + m];
  }
}

/* The gain about the path: where there is no plan. */
static void held(const tube_real *d, const tube_real *goal, const tube_real *rest, tube_real *u) {
  tube_real away[ND] = {0};
  for (int i = 0; i < NK; i++) away[keep[i]] = d[keep[i]] - goal[i];
  for (int i = 0; i < 3; i++) {
    away[D_POSITION + i] = clip(away[D_POSITION + i], -@near_position@, @near_position@);
    away[D_VELOCITY + i] = clip(away[D_VELOCITY + i], -@near_velocity@, @near_velocity@);
  }
  for (int j = 0; j < NU; j++) {
    u[j] = hover_u[j] + rest[NK + j];
    for (int i = 0; i < ND; i++) u[j] += gain[j][i] * away[i];
    u[j] /= c.ratio;
  }
}

/* The tilt that the plan before leads to, stage by stage, from the response d of stage k to hover's command. */
static void tilting(int k, const tube_real *d) {
  for (int i = 0; i < 2; i++) {
    tube_real sum = level[i] + d[keep[K_ATTITUDE + i]];
    for (int j = 0; j < k; j++)
      for (int m = 0; m < NU; m++) sum += response(k, j)[(K_ATTITUDE + i) * NU + m] * c.before[j][m];
    c.tilt[k][i] = sum;
  }
}

/* Whether the craft is so far from hover that the prediction cannot be trusted; linear.py says what that is. */
static int far_from_hover(const tube_real *d) {
  tube_real tilt = norm(d + keep[K_ATTITUDE], 2) / trusted[0], speed = norm(d + keep[K_VELOCITY], 3) / trusted[1];
  tube_real rate = norm(d + keep[K_RATE], 3) / trusted[2];
  return !(tilt * tilt + speed * speed + rate * rate <= 1);
}

/* By how much the plan misses limits of commands or their rates. */
static tube_real beyond(void) {
  tube_real most = 0;
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      tube_real v = c.solver.w[k][j];
      most = larger(most, larger(v - c.qp.upper[k][j], c.qp.lower[k][j] - v));
      if (k > 0) most = larger(most, fabs(v - c.solver.w[k - 1][j]) - c.qp.rate_max[j]);
    }
  return most;
}

/* By how much the plan is beyond a soft limit. */
static tube_real slack(void) {
  tube_real most = 0;
  for (int i = 0; i < c.solver.active; i++)
    if (c.solver.passed[i]) most = larger(most, (c.solver.of[i] - c.qp.penalty) / c.qp.penalty_square);
  return most;
}

/* The plan within its limits and, which comes first, its rates: cut off, limits that are still to be added are missed. */
static void clipped(void) {
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      tube_real v = clip(c.solver.w[k][j], c.qp.lower[k][j], c.qp.upper[k][j]), before = k > 0 ? c.solver.w[k - 1][j] : v;
      c.solver.w[k][j] = clip(v, before - c.qp.rate_max[j], before + c.qp.rate_max[j]);
    }
}

/* Without a plan: u within its limits. */
static unsigned unplanned(int status, tube_real *u) {
  c.known.plan_status = status;
  memset(c.before, 0, sizeof c.before);
  for (int j = 0; j < NU; j++) u[j] = allowed(all_finite(u + j, 1) ? u[j] : c.u[j], c.u[j]);
  return @UPPER@_TUBE_NO_SOLUTION;
}

/* Gradient and limits, from the error states d to hover's command. */
static void stated(const @NAME@_tube_path *path, const tube_real *planes, tube_real R[3][3], const tube_real *rest,
                   tube_real *d) {
  tube_real next[ND], goal[NK], kept[NK];
  memset(c.solver.g, 0, sizeof c.solver.g);
  for (int k = 0; k <= N; k++) {
    if (k < N) {
      bounded(k, rest);
      for (int j = 0; j < NU; j++) c.solver.g[k * NU + j] -= on_command * rest[NK + j];
      for (int j = 0; k == 0 && j < NU; j++) c.solver.g[j] -= on_change * (c.ratio * c.u[j] - hover_u[j]);
    }
    if (k > 0) {
      asked(path, k, R, rest, goal);
      drawn(k, d, goal);
      tilting(k, d);
      for (int i = 0; i < NK; i++) kept[i] = d[keep[i]];
      limited(planes ? planes + k * NPL * 4 : 0, k, R, path->position, kept);
    }
    for (int i = 0; i < ND; i++) {
      next[i] = 0;
      for (int m = 0; m < ND; m++) next[i] += transition[i * ND + m] * d[m];
    }
    memcpy(d, next, sizeof next);
  }
}

static unsigned decided(const @NAME@_tube_path *path, const tube_real *planes, int stages, tube_real *u) {
  tube_real R[3][3], d[ND], rest[NK + NU] = {0}, first[ND];
  unsigned said = 0;
  c.known.qp_iterations = 0;
  c.ratio = proportion();
  if (placed(path->position, d, R)) {
    for (int j = 0; j < NU; j++) u[j] = hover_u[j] / c.ratio;
    c.solver.active = 0;
    return unplanned(1, u);
  }
  if (far_from_hover(d)) said |= @UPPER@_TUBE_FAR_FROM_HOVER;
  for (int k = 0; k < stages && k < N; k++) memmove(c.before[0], c.before[1], (N - 1) * sizeof c.before[0]);
  for (int i = 0; i < NK + NU; i++)
    for (int j = 0; j < NFREE; j++) rest[i] += steady[i][j] * d[pushed_at[j]];
  for (int j = 0; j < NU; j++)
    if (hover_u[j] + rest[NK + j] > c.ratio * command_max) said |= @UPPER@_TUBE_WEAK;
  memcpy(first, d, sizeof first);
  stated(path, planes, R, rest, d);
  int status = qp_iterated(&c.solver, &c.qp, stages, @qp_tolerance@, @qp_iterations@, &c.known.qp_iterations);
  if (status > 1) c.solver.active = 0; /* cut off, the next goes on from there */
  if (status == 1) clipped();
  if (status > 1 || !(beyond() <= @primal_tolerance@)) {
    tube_real goal[NK];
    asked(path, 0, R, rest, goal);
    held(first, goal, rest, u);
    return said | unplanned(2, u);
  }
  if (status) said |= @UPPER@_TUBE_NOT_BEST;
  c.known.plan_status = 0;
  memcpy(c.before, c.solver.w, sizeof c.before);
  for (int j = 0; j < NU; j++) u[j] = allowed((hover_u[j] + c.solver.w[0][j]) / c.ratio, c.u[j]);
  if (slack() > @slack@) said |= @UPPER@_TUBE_SLACK;
  return said;
}
