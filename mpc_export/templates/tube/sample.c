
/* ------------------------------------------------------------------------------------------------------------------
   The sample: filter, gate, target, plan, fallback. controller.py and clock.py say why each is as it is,
   and what its numbers are. */

#define NY @n_y@
#define NE @n_e@
#define NF @n_x@ /* states of the filter, their own first */
#define OWN @own@
#define SENSORS @sensors@
#define STARTS @n_starts@
#define LAGS @lags@
#define EVERY @every@
#define TOLD @n_p@
#define PUSH @push@ /* state of the push along the thrust, -1: none */

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
/* run-time parameters: from where to where the model hovers with them, what was seen in training, what explains a push */
static const tube_real told_low[NP1] = @told_low@, told_high[NP1] = @told_high@;
static const tube_real seen_low[NP1] = @seen_low@, seen_high[NP1] = @seen_high@, per_force[NP1] = @per_force@;
static const tube_real clearly = @clearly@, believed_at = @believed@; /* rival.py */

enum { POSITION = @at_position@, VELOCITY = @at_velocity@, ATTITUDE = @at_attitude@, RATE = @at_rate@ };
enum { PUSHED, BARE, RIVALS };
enum { D_POSITION = @d_position@, D_VELOCITY = @d_velocity@ };

static struct {
@memory@  @NAME@_tube_model_int filter_iw[@filter_iw@];
  tube_real filter_w[@filter_w@];
  @NAME@_tube_known known;
  tube_real u[NU], past[LAGS][NU], p[NP1];
  tube_real wide[SENSORS], calm[SENSORS], missing[SENSORS], unseen[SENSORS];
  tube_real rival[RIVALS][NF], evidence[RIVALS], phase;
  tube_real told[NP1], age[NP1], flown;
  int heard[NP1], denied, has_rival[RIVALS], count, begun;
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

/* At rest at place, level, the hover command in force; x: its state. */
static void begin(const tube_real place[4], tube_real *x) {
  memset(&c, 0, sizeof c);
  memcpy(c.p, (const tube_real[NP1])@parameters@, sizeof c.p);
  for (int i = 0; i < TOLD; i++) c.age[i] = 1e9;
  memcpy(x, hover_x, sizeof hover_x);
  memcpy(x + POSITION, place, 3 * sizeof *place);
  /* level: a model that hovers tilted finds its tilt by itself */
  x[ATTITUDE] = cos(0.5 * place[3]);
  x[ATTITUDE + 1] = x[ATTITUDE + 2] = 0;
  x[ATTITUDE + 3] = sin(0.5 * place[3]);
  for (int j = 0; j < NU; j++) {
    c.u[j] = clip(hover_u[j], command_min, command_max);
    for (int k = 0; k < LAGS; k++) c.past[k][j] = c.u[j];
  }
  memcpy(c.known.estimate, x, OWN * sizeof *place);
  memcpy(c.known.estimate + OWN, (const tube_real[NF - OWN + 1])@filter_past@, (NF - OWN) * sizeof *place);
  for (int i = OWN; i < NX; i++) x[i] = c.past[lag_of[i - OWN]][command_of[i - OWN]];
  c.known.plan_status = -1;
  c.begun = 1;
}

const @NAME@_tube_known *@NAME@_tube_state(void) { return &c.known; }

/* -------------------------------------------------------------------------------------------------- run-time parameters */

void @NAME@_tube_parameter(int i, tube_real value) {
  if (i < 0 || i >= TOLD) return;
  c.told[i] = value;
  c.heard[i] = 1;
}

/* The push along the thrust gives way to a change of a parameter, so that their sum stays. */
static void explained(int i, tube_real by) {
  if (PUSH >= 0 && per_force[i] != 0) c.known.estimate[PUSH < 0 ? 0 : PUSH] -= by / per_force[i];
}

/* What was told of the parameters, and what the push along the thrust says of those that are not known (told.py). */
static unsigned heard(int called) {
  unsigned said = 0;
  for (int i = 0; i < TOLD; i++) {
    tube_real dark = fmin(c.age[i] - @present@, c.flown), value = c.told[i];
    c.age[i] += sample;
    if (called && c.heard[i]) {
      c.heard[i] = 0;
      if (value >= told_low[i] && value <= told_high[i]) {
        if (dark > 0) explained(i, (1 - exp(-dark / @slow@)) * (value - c.p[i]));
        c.p[i] = value;
        c.age[i] = 0;
      } else if (value != value) {
        c.age[i] = fmax(c.age[i], @present@ + sample);
      } else {
        said |= @UPPER@_TUBE_REFUSED;
      }
    }
    if (c.age[i] > @present@) {
      tube_real push = c.known.estimate[PUSH < 0 ? 0 : PUSH];
      tube_real found = PUSH < 0 ? c.p[i] : c.p[i] + sample / @slow@ * per_force[i] * push;
      found = clip(found, told_low[i], told_high[i]);
      explained(i, found - c.p[i]);
      c.p[i] = found;
      said |= @UPPER@_TUBE_NOT_TOLD;
    }
    if (!(c.p[i] >= seen_low[i] && c.p[i] <= seen_high[i])) said |= @UPPER@_TUBE_UNTRAINED;
  }
  c.flown += sample;
  if (PUSH >= 0 && c.known.estimate[PUSH < 0 ? 0 : PUSH] < @heaviest@) said |= @UPPER@_TUBE_HEAVY;
  return said;
}

/* -------------------------------------------------------------------------------------------------------- measurements */

static int filtered(const tube_real *x, const tube_real *y, const tube_real *there, tube_real *next, tube_real *e,
                    tube_real *y_hat) {
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
    for (int j = 0; j < NE; j++)
      part += inverse[i][j] == 0 ? 0 : inverse[i][j] * clip(all_finite(e + j, 1) ? e[j] : 1e15, -1e15, 1e15);
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

/* Lets an estimate that is begun at what is measured take over where it explains the measurements far better (rival.py). */
static unsigned challenged(const tube_real *before, const tube_real *y, const tube_real *there, const tube_real *e,
                           int denied) {
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
  unsigned said = heard(called);
  if (!present(y, given, clean, there) && called) said |= @UPPER@_TUBE_NO_MEASUREMENT;
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

static tube_real heading(const tube_real *x) {
  const tube_real *q = x + ATTITUDE;
  return atan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] * q[2] + q[3] * q[3]));
}

/* v within the limits of a command and, which comes first, its rate */
static tube_real allowed(tube_real v, tube_real before) {
  return clip(clip(v, command_min, command_max), before - rate_max, before + rate_max);
}

