
/* ------------------------------------------------------------------------------------------------------------------
   The sample: filter, gate, target, plan, fallback. controller.py says why each is as it is, and what its numbers are. */

#define NY @n_y@
#define NE @n_e@
#define NF @n_x@ /* states of the filter, their own first */
#define OWN @own@
#define SENSORS @sensors@
#define STARTS @n_starts@
#define LAGS @lags@
#define EVERY @every@

static const tube_real hover_x[NX] = @hover_x@, hover_u[NU] = @hover_u@;
static const tube_real sample = @sample@;
static const tube_real command_min = @low@, command_max = @high@, rate_max = @rate@, penalty = @penalty@,
                       penalty_square = @penalty_square@;
/* an innovation is formed from several columns, a sensor gives several innovations */
static const unsigned char columns[NE][NY] = @columns@;
static const unsigned char sensor_of[NE] = @sensor_of@, of_pose[SENSORS] = @of_pose@, of_sensor[SENSORS] = @of_sensor@;
static const tube_real inverse[NE][NE] = @inverse@; /* of the innovations' covariance, by sensor */
static const int attitude_columns[4] = @attitude_columns@; /* -1: not measured */
static const short start_from[STARTS + 1][2] = @start_from@; /* column, state */
static const short lag_of[NX - OWN + 1] = @lag_of@, command_of[NX - OWN + 1] = @command_of@;
static const int pushes[NFREE1] = TUBE_FREE;
static const tube_real most_push[NFREE + 1] = @most@; /* that rotors hold against */
static const tube_real turning[NU] = @turning@, turned = @turned@; /* heading.py */
static const tube_real clearly = @clearly@, believed_at = @believed@; /* rival.py */

enum { POSITION = @at_position@, VELOCITY = @at_velocity@, ATTITUDE = @at_attitude@, RATE = @at_rate@ };
enum { PUSHED, BARE, RIVALS };
enum { D_POSITION = @d_position@, D_VELOCITY = @d_velocity@ };

static struct {
  tube_solver solver;
  tube_data data;
  tube_model_int filter_iw[@filter_iw@];
  tube_real filter_w[@filter_w@];
  @NAME@_tube_known known;
  tube_real u[NU], past[LAGS][NU], p[NP1];
  tube_real steady_x[NX], steady_u[NU];
  tube_real plan_x[N + 1][NX], plan_u[N][NU]; /* that of the last solution */
  tube_real wide[SENSORS], calm[SENSORS], missing[SENSORS], unseen[SENSORS];
  tube_real rival[RIVALS][NF], evidence[RIVALS], phase, kappa_u;
  int adrift, denied, has_rival[RIVALS], has_plan, plan_age, failures, count, begun;
} c;

static int all_finite(const tube_real *v, int n) {
  for (int i = 0; i < n; i++)
    if (!(v[i] - v[i] == 0)) return 0;
  return 1;
}

static tube_real norm(const tube_real *v, int n) {
  tube_real sum = 0;
  for (int i = 0; i < n; i++) sum += v[i] * v[i];
  return sqrt(sum);
}

void @NAME@_tube_kappa(const tube_real kappa[NL], tube_real commands) {
  memcpy(c.data.kappa, kappa, sizeof c.data.kappa);
  c.data.kappa_u = c.kappa_u = commands;
}

int @NAME@_tube_start(const tube_real place[4]) {
  if (!all_finite(place, 4)) return 0;
  memset(&c, 0, sizeof c);
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
  memcpy(c.p, (const tube_real[NP1])@parameters@, sizeof c.p);
  memcpy(c.steady_x, hover_x, sizeof hover_x);
  memcpy(c.steady_x + POSITION, place, 3 * sizeof *place);
  /* level: a model that hovers tilted finds its tilt by itself */
  c.steady_x[ATTITUDE] = cos(0.5 * place[3]);
  c.steady_x[ATTITUDE + 1] = c.steady_x[ATTITUDE + 2] = 0;
  c.steady_x[ATTITUDE + 3] = sin(0.5 * place[3]);
  for (int j = 0; j < NU; j++) {
    c.data.u_min[j] = command_min;
    c.data.u_max[j] = command_max;
    c.data.rate_max[j] = rate_max;
    c.steady_u[j] = c.u[j] = clip(hover_u[j], command_min, command_max);
    for (int k = 0; k < LAGS; k++) c.past[k][j] = c.u[j];
    for (int k = 0; k < N; k++) c.data.u[k][j] = c.u[j];
  }
  memcpy(c.known.estimate, c.steady_x, OWN * sizeof *place);
  memcpy(c.known.estimate + OWN, (const tube_real[NF - OWN + 1])@filter_past@, (NF - OWN) * sizeof *place);
  for (int i = OWN; i < NX; i++) c.steady_x[i] = c.past[lag_of[i - OWN]][command_of[i - OWN]];
  for (int k = 0; k <= N; k++) memcpy(c.data.x[k], c.steady_x, sizeof c.steady_x);
  c.begun = 1;
  return 1;
}

const @NAME@_tube_known *@NAME@_tube_state(void) { return &c.known; }

/* -------------------------------------------------------------------------------------------------------- measurements */

static int filtered(const tube_real *x, const tube_real *y, const tube_real *there, tube_real *next, tube_real *e, tube_real *y_hat) {
  const tube_real *arg[@filter_arg@] = {x, c.u, c.p, y, there};
  tube_real *res[@filter_res@] = {next, e, y_hat};
  return @NAME@_tube_filter_filter_step(arg, res, c.filter_iw, c.filter_w, 0) || !all_finite(next, NF);
}

/* Which innovations what is measured gives; measurements without holes. Returns whether there is one. */
static int present(const tube_real *y, const unsigned char *given, tube_real *clean, tube_real *there) {
  int any = 0, lying = 0;
  for (int k = 0; k < NY; k++) clean[k] = given[k] && all_finite(y + k, 1) ? y[k] : (tube_real)INFINITY;
  if (attitude_columns[0] >= 0) {
    tube_real sum = 0;
    for (int k = 0; k < 4; k++) sum += clean[attitude_columns[k]] * clean[attitude_columns[k]];
    lying = !(sum >= 0.49 && sum <= 1.96);
  }
  for (int k = 0; lying && k < 4; k++) clean[attitude_columns[k]] = (tube_real)INFINITY;
  for (int i = 0; i < NE; i++) {
    there[i] = 1;
    for (int k = 0; k < NY; k++)
      if (columns[i][k] && !all_finite(clean + k, 1)) there[i] = 0;
    any |= there[i] != 0;
  }
  for (int k = 0; k < NY; k++)
    if (!all_finite(clean + k, 1)) clean[k] = 0;
  return any;
}

/* Of every sensor: its innovation in standard deviations over REACH, and whether all of it is there. */
static void sizes(const tube_real *e, const tube_real *there, tube_real *size, int *whole) {
  for (int k = 0; k < SENSORS; k++) {
    size[k] = 0;
    whole[k] = 1;
  }
  for (int i = 0; i < NE; i++) {
    tube_real part = 0;
    for (int j = 0; j < NE; j++) part += inverse[i][j] == 0 ? 0 : inverse[i][j] * clip(all_finite(e + j, 1) ? e[j] : 1e15, -1e15, 1e15);
    size[sensor_of[i]] += part * clip(all_finite(e + i, 1) ? e[i] : 1e15, -1e15, 1e15);
    if (there[i] == 0) whole[sensor_of[i]] = 0;
  }
  for (int k = 0; k < SENSORS; k++) size[k] = size[k] > 0 ? sqrt(size[k]) / 8 : 0;
}

static tube_real surprise(const tube_real *e, const tube_real *there) {
  tube_real size[SENSORS], sum = 0;
  int whole[SENSORS];
  sizes(e, there, size, whole);
  for (int k = 0; k < SENSORS; k++) {
    if (size[k] > 6) size[k] = 6;
    if (whole[k]) sum += 0.5 * (tube_real)(1 + of_sensor[k]) * log1p(size[k] * size[k]);
  }
  return sum;
}

/* Share of every sensor's innovation that is believed; see gate.py. */
static void gated(const tube_real *e, const tube_real *there, tube_real *share, int *whole) {
  tube_real size[SENSORS];
  sizes(e, there, size, whole);
  for (int k = 0; k < SENSORS; k++) {
    tube_real room = exp2(c.wide[k] + 0.5 * c.missing[k]);
    share[k] = 1;
    if (!whole[k]) {
      c.missing[k] = c.missing[k] + 1 < 12 ? c.missing[k] + 1 : 12;
      continue;
    }
    c.missing[k] = 0;
    if (size[k] <= room) {
      if (size[k] <= exp2(c.calm[k])) c.wide[k] = c.calm[k];
      c.calm[k] = c.wide[k] = fmax(c.wide[k] - 0.02, log2(size[k] > 1 ? size[k] : 1));
    } else {
      share[k] = size[k] <= 6 * room ? room / size[k] : 0;
      c.wide[k] = c.wide[k] + 1 < 40 ? c.wide[k] + 1 : 40;
    }
  }
}

/* y moved toward what was expected, so that `share` of its innovation is left. */
static unsigned believed(const tube_real *share, const tube_real *y_hat, tube_real *y, tube_real *there) {
  unsigned said = 0;
  unsigned char moved[NY] = {0};
  for (int i = 0; i < NE; i++) {
    tube_real part = share[sensor_of[i]], sign = 1;
    if (part == 0) {
      there[i] = 0;
      said |= @UPPER@_TUBE_NOT_BELIEVED;
    } else if (part < 1) {
      said |= @UPPER@_TUBE_DOUBTED;
      if (attitude_columns[0] >= 0 && columns[i][attitude_columns[0]]) {
        /* a quaternion and its negative are one attitude */
        tube_real product = 0;
        for (int k = 0; k < 4; k++) product += y[attitude_columns[k]] * y_hat[attitude_columns[k]];
        if (product < 0) sign = -1;
      }
      for (int k = 0; k < NY; k++) {
        if (!columns[i][k] || moved[k]) continue;
        moved[k] = 1;
        y[k] = y_hat[k] + part * (sign * y[k] - y_hat[k]);
      }
    }
  }
  return said;
}

/* The state that the measurements of one sample say, pushed as `before` is if rotors could hold against it; at rest where
   they say nothing. */
static void measured(const tube_real *before, const tube_real *y, const tube_real *there, int pushed, tube_real *x) {
  memcpy(x, hover_x, OWN * sizeof *x);
  for (int i = 0; i < NFREE; i++) pushed &= fabs(before[pushes[i]]) < most_push[i];
  for (int i = 0; pushed && i < NFREE; i++) x[pushes[i]] = before[pushes[i]];
  memcpy(x + OWN, before + OWN, (NF - OWN) * sizeof *x);
  for (int k = 0; k < STARTS; k++)
    for (int i = 0; i < NE; i++)
      if (columns[i][start_from[k][0]] && there[i] != 0) x[start_from[k][1]] = y[start_from[k][0]];
  tube_real length = norm(x + ATTITUDE, 4);
  for (int k = 0; k < 4; k++) x[ATTITUDE + k] /= length;
}

/* Lets an estimate that is begun at what is measured take over where it explains the measurements far better; see rival.py. */
static unsigned challenged(const tube_real *before, const tube_real *y, const tube_real *there, const tube_real *e, int denied) {
  tube_real surprised = surprise(e, there), next[NF], off[NE], y_hat[NY], start[NF];
  for (int r = 0; r < RIVALS; r++) {
    if (!c.has_rival[r]) continue;
    int failed = filtered(c.rival[r], y, there, next, off, y_hat);
    tube_real gained = surprised - surprise(off, there);
    c.evidence[r] += gained;
    c.has_rival[r] = gained > 0 && !failed;
    memcpy(c.rival[r], next, sizeof next);
  }
  int posed = 1;
  for (int i = 0; i < NE; i++)
    if (of_pose[sensor_of[i]] && there[i] == 0) posed = 0;
  int calm = posed && surprised < clearly;
  for (int k = 0; k < SENSORS; k++) calm &= c.wide[k] == 0;
  c.denied = denied || (c.denied && !calm);
  if (!c.has_rival[PUSHED] && !c.has_rival[BARE] && c.denied && surprised >= clearly && posed)
    for (int r = 0; r < RIVALS; r++) {
      measured(before, y, there, r == PUSHED, start);
      c.has_rival[r] = !filtered(start, y, there, c.rival[r], off, y_hat);
      c.evidence[r] = 0;
    }
  int more = c.has_rival[PUSHED] && c.evidence[PUSHED] >= c.evidence[BARE] + clearly;
  int r = c.has_rival[BARE] && !more ? BARE : PUSHED;
  if (!c.has_rival[r] || c.evidence[r] < believed_at) return 0;
  memcpy(c.known.estimate, c.rival[r], sizeof c.rival[r]);
  c.denied = c.has_rival[PUSHED] = c.has_rival[BARE] = 0;
  for (int k = 0; k < SENSORS; k++) c.wide[k] = c.calm[k] = c.missing[k] = c.unseen[k] = 0;
  return @UPPER@_TUBE_FILTER_ANEW;
}

static unsigned seen(const tube_real *y, const unsigned char *given, int called) {
  tube_real clean[NY], there[NE], e[NE], y_hat[NY], next[NF], share[SENSORS], used[NE], moved[NY], before[NF];
  int whole[SENSORS], doubted = 0, denied = 0, failed;
  unsigned said = present(y, given, clean, there) || !called ? 0 : @UPPER@_TUBE_NO_MEASUREMENT;
  memcpy(before, c.known.estimate, sizeof before);
  failed = filtered(before, clean, there, next, e, y_hat);
  memcpy(moved, clean, sizeof moved);
  memcpy(used, there, sizeof used);
  gated(e, there, share, whole);
  for (int k = 0; k < SENSORS; k++) {
    doubted |= share[k] < 1;
    denied |= share[k] == 0;
  }
  if (doubted) {
    tube_real again[NE];
    said |= believed(share, y_hat, moved, used);
    failed = filtered(before, moved, used, next, again, y_hat);
  }
  c.known.seconds_since_pose = 0;
  for (int k = 0; k < SENSORS; k++) {
    c.unseen[k] = whole[k] && share[k] > 0 ? 0 : c.unseen[k] + sample;
    if (of_pose[k] && c.unseen[k] > c.known.seconds_since_pose) c.known.seconds_since_pose = c.unseen[k];
  }
  if (c.known.seconds_since_pose > @blind@) said |= @UPPER@_TUBE_BLIND;
  if (failed)
    said |= @UPPER@_TUBE_FILTER_FAILED;
  else
    memcpy(c.known.estimate, next, sizeof next);
  return said | challenged(before, clean, there, e, denied);
}

/* ---------------------------------------------------------------------------------------------------------------- plans */

/* The plan's state: the estimate, with the history of commands at the plan's sample time. */
static void planned_from(tube_real *x) {
  memcpy(x, c.known.estimate, OWN * sizeof *x);
  for (int i = OWN; i < NX; i++) x[i] = c.past[lag_of[i - OWN]][command_of[i - OWN]];
}

static int flown(const tube_real *x, const tube_real *u, tube_real *next) {
  const tube_real *arg[TUBE_ARG] = {x, u, c.p};
  tube_real *res[TUBE_RES] = {next};
  return tube_model_tube_step(arg, res, c.solver.iw, c.solver.w, 0) || !all_finite(next, NX);
}

/* A Newton step of the steady state from (x, u); returns by how much (x, u) missed. */
static tube_real steadier(const tube_real *x, const tube_real *u, const tube_real *goal, tube_real *next_x, tube_real *next_u) {
  tube_real from[NX], residual = (tube_real)INFINITY;
  memcpy(from, x, sizeof from);
  for (int i = 0; i < NFREE; i++) from[pushes[i]] = c.known.estimate[pushes[i]];
  const tube_real *arg[TUBE_ARG] = {from, u, c.p, goal};
  tube_real *res[TUBE_RES] = {next_x, next_u, &residual};
  if (tube_model_target_step(arg, res, c.solver.iw, c.solver.w, 0)) return (tube_real)INFINITY;
  return all_finite(&residual, 1) ? residual : (tube_real)INFINITY;
}

static tube_real heading(const tube_real *x) {
  const tube_real *q = x + ATTITUDE;
  return atan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] * q[2] + q[3] * q[3]));
}

/* The least and the most by which u can be moved within its limits so that it turns and does nothing else; the least is
   larger where it cannot. */
static void room(const tube_real *u, tube_real *least, tube_real *most) {
  int turns = 0;
  *least = -INFINITY;
  *most = INFINITY;
  for (int j = 0; j < NU; j++) {
    tube_real low = command_min * fabs(command_min) - u[j] * fabs(u[j]), high = command_max * fabs(command_max) - u[j] * fabs(u[j]);
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

/* v within the limits of a command and, which comes first, its rate */
static tube_real allowed(tube_real v, tube_real before) {
  return clip(clip(v, command_min, command_max), before - rate_max, before + rate_max);
}

/* u and the ancillary gain on what `state` is away from x. */
static void corrected(const tube_real *state, const tube_real *before, const tube_real *x, const tube_real *u, tube_real *out) {
  tube_real away[ND];
  const tube_real *arg[TUBE_ARG] = {state, x};
  tube_real *res[TUBE_RES] = {away};
  if (tube_model_boxminus(arg, res, c.solver.iw, c.solver.w, 0)) memset(away, 0, sizeof away);
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
  c.failures = c.plan_age = 0;
  c.has_plan = 1;
  memcpy(u, d->u[0], sizeof d->u[0]);
  return said;
}

/* Samples since the call before: 1, more where calls did not come. Early and late calls even out. */
static int samples(tube_real passed, unsigned *said) {
  int whole;
  if (!(passed >= -1e-6 && passed <= 0.25)) {
    c.phase = 0;
    *said |= @UPPER@_TUBE_CLOCK;
    return 1;
  }
  c.phase += passed / sample;
  whole = (int)(c.phase + 0.25);
  if (whole < 1) whole = 1;
  c.phase = clip(c.phase - (tube_real)whole, -1, 1);
  if (whole > 1) *said |= @UPPER@_TUBE_CALLS_MISSED;
  return whole;
}

unsigned @NAME@_tube_step(tube_real passed, const tube_real y[NY], const unsigned char given[NY], const @NAME@_tube_path path[N + 1],
                          const tube_real *planes, tube_real u[NU]) {
  static const unsigned char none[NY] = {0};
  unsigned said = 0;
  int whole, due;
  if (!c.begun) {
    for (int j = 0; j < NU; j++) u[j] = clip(hover_u[j], command_min, command_max);
    return @UPPER@_TUBE_NOT_STARTED;
  }
  whole = samples(passed, &said);
  for (int k = 1; k < whole; k++) said |= seen(y, none, 0);
  said |= seen(y, given, 1);
  c.count += whole;
  due = c.count / EVERY;
  c.count %= EVERY;
  if (due) {
    tube_real wanted[NU];
    for (int k = 0; k < due && k < LAGS; k++) {
      memmove(c.past[1], c.past[0], (LAGS - 1) * sizeof c.past[0]);
      memcpy(c.past[0], c.u, sizeof c.u);
    }
    said |= decided(path, planes, due, wanted);
    for (int j = 0; j < NU; j++) {
      tube_real v = allowed(all_finite(wanted + j, 1) ? wanted[j] : c.u[j], c.u[j]);
      if (!(fabs(v - wanted[j]) <= @rounding@)) said |= @UPPER@_TUBE_BEYOND_LIMITS;
      c.u[j] = v;
    }
  }
  memcpy(u, c.u, sizeof c.u);
  return said;
}
