static const tube_real turning[NU] = @turning@, turned = @turned@; /* heading.py */

void @NAME@_tube_kappa(const tube_real kappa[NL], tube_real commands) {
  memcpy(c.data.kappa, kappa, sizeof c.data.kappa);
  c.data.kappa_u = c.kappa_u = commands;
}

int @NAME@_tube_start(const tube_real place[4]) {
  tube_real x[NX];
  if (!all_finite(place, 4)) return 0;
  begin(place, x);
  @NAME@_tube_kappa((const tube_real[NL])@kappa@, @kappa_u@);
  qp_renew(&c.solver.solver);
  for (int k = 0; k <= N; k++)
    for (int j = 0; j < NL; j++) c.data.wider[k][j] = 1;
  memcpy(c.data.bent, bent, sizeof c.data.bent);
  c.data.penalty = penalty;
  c.data.penalty_square = penalty_square;
  c.data.tolerance = @tolerance@;
  c.data.qp_tolerance = @qp_tolerance@;
  c.data.primal_tolerance = @primal_tolerance@;
  c.data.iterations_max = c.data.tube_updates_max = 1;
  c.data.qp_iterations_max = @qp_iterations@;
  c.data.attempts_max = @attempts@;
  for (int j = 0; j < NU; j++) {
    c.data.u_min[j] = command_min;
    c.data.u_max[j] = command_max;
    c.data.rate_max[j] = rate_max;
    for (int k = 0; k < N; k++) c.data.u[k][j] = c.u[j];
  }
  for (int k = 0; k <= N; k++) memcpy(c.data.x[k], x, sizeof x);
  memcpy(c.steady_x, x, sizeof x);
  memcpy(c.steady_u, c.u, sizeof c.u);
  return 1;
}

static int flown(const tube_real *x, const tube_real *u, tube_real *next) {
  const tube_real *arg[TUBE_ARG] = {x, u, c.p};
  tube_real *res[TUBE_RES] = {next};
  return @NAME@_tube_model_tube_step(arg, res, c.solver.iw, c.solver.w, 0) || !all_finite(next, NX);
}

/* A Newton step of the steady state from (x, u); returns by how much (x, u) missed. */
static tube_real steadier(const tube_real *x, const tube_real *u, const tube_real *goal, tube_real *next_x,
                          tube_real *next_u) {
  tube_real from[NX], residual = (tube_real)INFINITY;
  memcpy(from, x, sizeof from);
  for (int i = 0; i < NFREE; i++) from[pushes[i]] = c.known.estimate[pushes[i]];
  const tube_real *arg[TUBE_ARG] = {from, u, c.p, goal};
  tube_real *res[TUBE_RES] = {next_x, next_u, &residual};
  if (@NAME@_tube_model_target_step(arg, res, c.solver.iw, c.solver.w, 0)) return (tube_real)INFINITY;
  return all_finite(&residual, 1) ? residual : (tube_real)INFINITY;
}

/* The least and the most by which u can be moved within its limits so that it turns and does nothing else; the least is
   larger where it cannot. */
static void room(const tube_real *u, tube_real *least, tube_real *most) {
  int turns = 0;
  *least = -INFINITY;
  *most = INFINITY;
  for (int j = 0; j < NU; j++) {
    tube_real low = command_min * fabs(command_min) - u[j] * fabs(u[j]);
    tube_real high = command_max * fabs(command_max) - u[j] * fabs(u[j]);
    if (turning[j] == 0) {
      if (u[j] >= command_min && u[j] <= command_max) continue;
      *least = INFINITY;
      *most = -INFINITY;
      return;
    }
    turns = 1;
    *least = fmax(*least, fmin(low / turning[j], high / turning[j]));
    *most = fmin(*most, fmax(low / turning[j], high / turning[j]));
  }
  if (!turns) *least = *most = 0;
}

/* The path with headings that the command to spare can turn to. */
static void slowly_turning(const @NAME@_tube_path *path, @NAME@_tube_path *out) {
  tube_real least, most, now = heading(c.known.estimate);
  room(c.steady_u, &least, &most);
  tube_real one = 0.5 * turned * least, other = 0.5 * turned * most;
  for (int k = 0; k <= N; k++) {
    tube_real away = path[k].yaw - now;
    away = atan2(sin(away), cos(away));
    out[k] = path[k];
    out[k].yaw = now + clip(away, fmin(fmin(one, other), -@near_heading@), fmax(fmax(one, other), @near_heading@));
  }
}

/* Standard deviations by which the commands are tightened: half of the way from the steady command to its limits is the
   plan's. */
static tube_real affordable(void) {
  tube_real share = INFINITY;
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++)
      if (c.data.backoff_u[k][j] > 0)
        share = fmin(share, 0.5 * fmin(command_max - c.steady_u[j], c.steady_u[j] - command_min) / c.data.backoff_u[k][j]);
  return share < INFINITY ? fmin(c.kappa_u, fmax(c.data.kappa_u * share, @rounding@ * c.kappa_u)) : c.kappa_u;
}

/* One Newton step of the steady state that holds the path's place under the estimated disturbance. */
static unsigned aimed(const @NAME@_tube_path *path) {
  tube_real goal[4], x[NX], u[NU], other_x[NX], other_u[NU], most = 0;
  memcpy(goal, path->position, sizeof path->position);
  goal[3] = path->yaw;
  tube_real missed = steadier(c.steady_x, c.steady_u, goal, x, u);
  if (!(missed < @near_steady@) && steadier(hover_x, hover_u, goal, other_x, other_u) <= missed) {
    memcpy(x, other_x, sizeof x);
    memcpy(u, other_u, sizeof u);
  }
  if (!all_finite(x, NX) || !all_finite(u, NU)) return 0;
  memcpy(c.steady_x, x, sizeof x);
  tube_real low, high, by;
  room(u, &low, &high);
  by = clip(0, low, high);
  c.adrift = low <= high && by != 0;
  for (int j = 0; j < NU; j++) {
    tube_real square = u[j] * fabs(u[j]) + by * turning[j];
    most = fmax(most, u[j]);
    c.steady_u[j] = clip(c.adrift ? copysign(sqrt(fabs(square)), square) : u[j], command_min, command_max);
  }
  int held = low <= high && fabs(by * turned) + @held@ * fabs(c.known.estimate[RATE + 2]) <= @most_turn@;
  return most > command_max && !held ? @UPPER@_TUBE_WEAK : 0;
}

/* Attitude with thrust along `up`, of length 1, and the body's x axis toward yaw. */
static void tilted(const tube_real *up, tube_real yaw, tube_real *q) {
  tube_real side[3], front[3], toward[2] = {cos(yaw), sin(yaw)}, length, w;
  side[0] = -up[2] * toward[1];
  side[1] = up[2] * toward[0];
  side[2] = up[0] * toward[1] - up[1] * toward[0];
  length = fmax(norm(side, 3), 1e-9);
  for (int i = 0; i < 3; i++) side[i] /= length;
  front[0] = side[1] * up[2] - side[2] * up[1];
  front[1] = side[2] * up[0] - side[0] * up[2];
  front[2] = side[0] * up[1] - side[1] * up[0];
  w = 0.5 * sqrt(fmax(1 + front[0] + side[1] + up[2], 1e-12));
  q[0] = w;
  q[1] = (side[2] - up[1]) / (4 * w);
  q[2] = (up[0] - front[2]) / (4 * w);
  q[3] = (front[1] - side[0]) / (4 * w);
}

static void thrust_axis(const tube_real *q, tube_real *up) {
  up[0] = 2 * (q[1] * q[3] + q[0] * q[2]);
  up[1] = 2 * (q[2] * q[3] - q[0] * q[1]);
  up[2] = 1 - 2 * (q[1] * q[1] + q[2] * q[2]);
}

/* State on the path: thrust along its acceleration and what the steady state holds against; rotors and rates at rest. */
static void along(const @NAME@_tube_path *path, tube_real *x) {
  tube_real up[3], length, w;
  memcpy(x, c.steady_x, NX * sizeof *x);
  thrust_axis(c.steady_x + ATTITUDE, up);
  w = 9.80665 / (up[2] > 0.1 ? up[2] : 0.1);
  for (int i = 0; i < 3; i++) up[i] = path->acceleration[i] + w * up[i];
  length = fmax(norm(up, 3), 1e-9);
  for (int i = 0; i < 3; i++) up[i] /= length;
  tilted(up, path->yaw, x + ATTITUDE);
  memcpy(x + POSITION, path->position, sizeof path->position);
  memcpy(x + VELOCITY, path->velocity, sizeof path->velocity);
  for (int i = 0; i < 3; i++) x[RATE + i] = 0;
}

/* The heading that the plan has anyway becomes its reference, and so does its rate at the end. */
static void give_up_heading(void) {
  tube_real up[3];
  tube_data *d = &c.data;
  for (int k = 0; k < N; k++) d->ref[k][6] = heading(d->x[k]);
  thrust_axis(d->x_end + ATTITUDE, up);
  tilted(up, heading(d->x[N]), d->x_end + ATTITUDE);
  d->x_end[RATE + 2] = d->x[N][RATE + 2];
}

/* u and the ancillary gain on what `state` is away from x. */
static void corrected(const tube_real *state, const tube_real *before, const tube_real *x, const tube_real *u,
                      tube_real *out) {
  tube_real away[ND];
  const tube_real *arg[TUBE_ARG] = {state, x};
  tube_real *res[TUBE_RES] = {away};
  if (@NAME@_tube_model_boxminus(arg, res, c.solver.iw, c.solver.w, 0)) memset(away, 0, sizeof away);
  tube_real place = norm(away + D_POSITION, 3), speed = norm(away + D_VELOCITY, 3);
  for (int i = 0; i < 3; i++) {
    if (place > @near_position@) away[D_POSITION + i] *= @near_position@ / place;
    if (speed > @near_velocity@) away[D_VELOCITY + i] *= @near_velocity@ / speed;
  }
  for (int j = 0; j < NU; j++) {
    tube_real v = u[j];
    for (int i = 0; i < ND; i++) v += gain[j][i] * away[i];
    out[j] = allowed(all_finite(&v, 1) ? v : before[j], before[j]);
  }
}

/* A plan that owes nothing to the one before: the fallback about the path, simulated from the estimate. */
static void anew(const @NAME@_tube_path *path) {
  tube_real x[NX], goal[NX];
  const tube_real *before = c.u;
  planned_from(x);
  for (int k = 0; k < N; k++) {
    along(path + k, goal);
    corrected(x, before, goal, c.steady_u, c.data.u[k]);
    before = c.data.u[k];
    memcpy(c.data.x[k], x, sizeof x);
    if (flown(c.data.x[k], before, x)) along(path + k + 1, x);
  }
  memcpy(c.data.x[N], x, sizeof x);
}

/* The plan before, one stage on; its last command is held. */
static void shifted(void) {
  memmove(c.data.u[0], c.data.u[1], (N - 1) * sizeof c.data.u[0]);
  memmove(c.data.x[0], c.data.x[1], N * sizeof c.data.x[0]);
  flown(c.data.x[N - 1], c.data.u[N - 1], c.data.x[N]);
}

/* The plan before with the ancillary gain, while it lasts; then the gain about the path. */
static void fallen_back(const @NAME@_tube_path *path, tube_real *u) {
  tube_real state[NX], x[NX];
  const tube_real *command = c.steady_u;
  along(path, x);
  if (c.has_plan && c.plan_age < N) {
    memcpy(x, c.plan_x[c.plan_age], sizeof x);
    command = c.plan_u[c.plan_age];
  }
  planned_from(state);
  corrected(state, c.u, x, command, u);
}

static unsigned decided(const @NAME@_tube_path *asked, const tube_real *planes, int stages, tube_real *u) {
  @NAME@_tube_path path[N + 1];
  slowly_turning(asked, path);
  unsigned said = aimed(path);
  tube_data *d = &c.data;
  d->kappa_u = affordable();
  planned_from(d->x0);
  memcpy(d->u_before, c.u, sizeof c.u);
  memcpy(d->p, c.p, sizeof c.p);
  for (int k = 0; k <= N; k++) {
    for (int j = 0; j < NPL; j++)
      for (int i = 0; i < 4; i++) d->plane[k][j][i] = planes ? planes[(k * NPL + j) * 4 + i] : (tube_real)(i == 3);
    if (k == N) break;
    memcpy(d->ref[k], path[k].position, sizeof path->position);
    memcpy(d->ref[k] + 3, path[k].velocity, sizeof path->velocity);
    d->ref[k][6] = path[k].yaw;
    memcpy(d->ref[k] + 7, c.steady_u, sizeof c.steady_u);
  }
  c.plan_age = c.has_plan ? c.plan_age + stages : 1;
  memcpy(c.plan_x, d->x, sizeof d->x);
  memcpy(c.plan_u, d->u, sizeof d->u);
  if (c.failures >= @failures@ || c.plan_age > N)
    anew(path);
  else
    for (int k = 0; k < c.plan_age; k++) shifted();
  along(path + N, d->x_end);
  if (c.adrift) give_up_heading();
  c.known.plan_status = tube_solve(&c.solver, d);
  c.known.qp_iterations = (int)d->qp_iterations;
  if (c.known.plan_status) {
    memcpy(d->x, c.plan_x, sizeof d->x);
    memcpy(d->u, c.plan_u, sizeof d->u);
    c.failures++;
    fallen_back(path, u);
    return said | @UPPER@_TUBE_NO_SOLUTION;
  }
  if ((int)d->qp_status != 0) said |= @UPPER@_TUBE_NOT_BEST;
  if (d->clipped > @rounding@) said |= @UPPER@_TUBE_CLIPPED;
  if (largest(d->slack[1], N * NL) > @slack@) said |= @UPPER@_TUBE_SLACK;
  c.failures = c.plan_age = 0;
  c.has_plan = 1;
  memcpy(u, d->u[0], sizeof d->u[0]);
  return said;
}

