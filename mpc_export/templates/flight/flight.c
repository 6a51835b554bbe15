#include "@NAME@_flight.h"

#include <math.h>
#include <string.h>

/* hover */
@hover@
/* an innovation is formed from several columns */
static const unsigned char columns[@UPPER@_N_E][@UPPER@_N_Y] = {
@columns@
};
/* standard deviations of the innovations */
@spread@
/* column, state: a pose to start from, then what else is taken over where it is measured */
#define POSE @pose@
#define STARTS @starts@
static const short start_from[STARTS + 1][2] = {@start_from@{0, 0}};

static int is_finite(@real@ v) { return v - v == 0; }

static int all_finite(const @real@ *v, int n) {
  int i;
  for (i = 0; i < n; ++i) {
    if (!is_finite(v[i])) return 0;
  }
  return 1;
}

int @NAME@_flight_start(@NAME@_flight *f, const @real@ place[4]) {
  memset(f, 0, sizeof *f);
  memcpy(f->x, hover_x, sizeof f->x);
  memcpy(f->u, hover_u, sizeof f->u);
@parameters@
  if (!all_finite(place, 4)) return 0;
  f->x[@UPPER@_X_POSITION_X] = place[0];
  f->x[@UPPER@_X_POSITION_Y] = place[1];
  f->x[@UPPER@_X_POSITION_Z] = place[2];
  f->x[@UPPER@_X_ATTITUDE_W] = @cos@(@half@ * place[3]);
  f->x[@UPPER@_X_ATTITUDE_Z] = @sin@(@half@ * place[3]);
  memcpy(f->goal, place, sizeof f->goal);
  f->begun = 1;
  return 1;
}

void @NAME@_flight_parameter(@NAME@_flight *f, int i, @real@ value) {
  if (i >= 0 && i < @UPPER@_N_P && is_finite(value) && value > 0) f->p[i] = value;
}

/* What is there, without a vector whose length no measurement has. Returns whether one was. */
static int absurd(const @real@ *y, const unsigned char *given, unsigned char *kept) {
  int bad = 0;
  memcpy(kept, given, @UPPER@_N_Y);
@lengths@  (void)y;
  return bad;
}

/* Starts again from a whole pose that is measured; a model that measures none keeps the pose that it believes in. */
static int begin(@NAME@_flight *f, const @real@ *y, const unsigned char *given) {
  @real@ old[@UPPER@_N_X];
  int k;
  for (k = 0; k < POSE; ++k) {
    if (!given[start_from[k][0]] || !is_finite(y[start_from[k][0]])) return 0;
  }
  if (!POSE && !f->begun) return 0;
  memcpy(old, f->x, sizeof old);
  memcpy(f->x, hover_x, sizeof f->x);
  if (!POSE) {
    for (k = 0; k < 3; ++k) f->x[@UPPER@_X_POSITION_X + k] = old[@UPPER@_X_POSITION_X + k];
    for (k = 0; k < 4; ++k) f->x[@UPPER@_X_ATTITUDE_W + k] = old[@UPPER@_X_ATTITUDE_W + k];
  }
  for (k = 0; k < STARTS; ++k) {
    if (given[start_from[k][0]] && is_finite(y[start_from[k][0]])) f->x[start_from[k][1]] = y[start_from[k][0]];
  }
  if (!f->begun) {
    const @real@ *q = &f->x[@UPPER@_X_ATTITUDE_W];
    memcpy(f->goal, &f->x[@UPPER@_X_POSITION_X], 3 * sizeof *q);
    f->goal[3] = @atan2@(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] * q[2] + q[3] * q[3]));
  }
  f->begun = 1;
  f->missed = 0;
  return 1;
}

/* The innovations that what is there gives, and measurements without holes. */
static void seen(const @real@ *y, const unsigned char *given, @real@ *clean, @real@ *there) {
  int i, k;
  for (k = 0; k < @UPPER@_N_Y; ++k) clean[k] = given[k] && is_finite(y[k]) ? y[k] : 0;
  for (i = 0; i < @UPPER@_N_E; ++i) {
    there[i] = 1;
    for (k = 0; k < @UPPER@_N_Y; ++k) {
      /* a number that is none is not there either */
      if (columns[i][k] && !(given[k] && is_finite(y[k]))) there[i] = 0;
    }
  }
}

/* Whether two innovations are formed from the same column. */
static int together(int i, int j) {
  int k;
  for (k = 0; k < @UPPER@_N_Y; ++k) {
    if (columns[i][k] && columns[j][k]) return 1;
  }
  return 0;
}

static int of_pose(int i) {
  int k;
  for (k = 0; k < POSE; ++k) {
    if (columns[i][start_from[k][0]]) return 1;
  }
  return 0;
}

/* Takes away what no measurement can be, and what was measured with it. Returns how many innovations it took, of a pose
   in *poses. */
static int refuse(const @NAME@_flight *f, @real@ *there, int *poses) {
  unsigned char bad[@UPPER@_N_E];
  int i, j, taken = 0;
  for (i = 0; i < @UPPER@_N_E; ++i) {
    const @real@ most = @UPPER@_FLIGHT_GATE * spread[i];
    bad[i] = there[i] != 0 && !(f->e[i] <= most && f->e[i] >= -most);
  }
  for (i = 0; i < @UPPER@_N_E; ++i) {
    for (j = 0; bad[i] && j < @UPPER@_N_E; ++j) {
      if (there[j] == 0 || !together(i, j)) continue;
      there[j] = 0;
      *poses += of_pose(j);
      ++taken;
    }
  }
  return taken;
}

static int evaluated(@NAME@_flight *f, const @real@ *clean, const @real@ *there, const @real@ *goal, @real@ *x_next,
                     @real@ *u_next) {
  if (!goal) return @NAME@_eval_@filter@(f->x, f->u, f->p, clean, there, x_next, f->e, f->y_hat, &f->work);
  return @NAME@_eval_pilot_step(f->x, f->u, f->p, clean, there, goal, x_next, u_next, f->e, f->y_hat, &f->work);
}

static int farther(const @real@ *from, const @real@ *to, @real@ most) {
  const @real@ d[3] = {from[0] - to[0], from[1] - to[1], from[2] - to[2]};
  return d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > most * most;
}

static int lasts(unsigned *count, int now) {
  *count = now ? *count + 1 : 0;
  if (*count > @UPPER@_FLIGHT_LASTING) *count = @UPPER@_FLIGHT_LASTING;
  return *count >= @UPPER@_FLIGHT_LASTING;
}

/* What the pilot cannot do, if it lasts, with the command u. goal: 0 where somebody else flies. */
static int said(@NAME@_flight *f, const @real@ *goal, const @real@ *u) {
  const @real@ rest[3] = {0};
  int k, limit = 0;
  const int far = goal && (farther(&f->x[@UPPER@_X_POSITION_X], goal, @position@) ||
                           farther(&f->x[@UPPER@_X_VELOCITY_X], rest, @velocity@));
  for (k = 0; goal && k < @UPPER@_N_U; ++k) limit |= u[k] <= @NAME@_u_lower[k] || u[k] >= @NAME@_u_upper[k];
  return (lasts(&f->far, far) ? @UPPER@_FLIGHT_FAR : 0) | (lasts(&f->limit, limit) ? @UPPER@_FLIGHT_LIMIT : 0);
}

/* One sample, with a command for goal or, without goal, the filter alone. u_next is hover's where nothing else helped. */
static int stepped(@NAME@_flight *f, const @real@ *y, const unsigned char *told, const @real@ *goal, @real@ *u_next) {
  @real@ clean[@UPPER@_N_Y], there[@UPPER@_N_E], x_next[@UPPER@_N_X];
  unsigned char given[@UPPER@_N_Y];
  int i, poses = 0, refused, used = 0;
  /* zeros are how a tracker says that it sees nothing: no pose that is refused */
  const int without = absurd(y, told, given);
  memcpy(u_next, hover_u, sizeof f->u);
  memset(f->used, 0, sizeof f->used);
  if ((!f->begun || f->missed >= @UPPER@_FLIGHT_RESTART) && !begin(f, y, given) && !f->begun) {
    ++f->failures;
    return f->code = @UPPER@_NOT_FINITE_INPUT;
  }
  seen(y, given, clean, there);
  memset(f->e, 0, sizeof f->e);
  f->code = evaluated(f, clean, there, goal, x_next, u_next);
  refused = refuse(f, there, &poses);
  if (refused) f->code = evaluated(f, clean, there, goal, x_next, u_next);
  if (f->code > @UPPER@_OUT_OF_RANGE) {
    /* the prediction goes on without measurements */
    memset(there, 0, sizeof there);
    memset(clean, 0, sizeof clean);
    poses = refused = 1;
    f->code = evaluated(f, clean, there, goal, x_next, u_next);
  }
  if (refused || without) ++f->refused;
  for (i = 0; i < @UPPER@_N_E; ++i) {
    f->used[i] = there[i] != 0;
    used += f->used[i] && of_pose(i);
  }
  if (f->code > @UPPER@_OUT_OF_RANGE) {
    memcpy(u_next, hover_u, sizeof f->u);
    /* nothing is known of this sample: no row goes on */
    f->said = 0;
    f->far = f->limit = 0;
    ++f->failures;
    ++f->missed;
    return f->code;
  }
  memcpy(f->x, x_next, sizeof f->x);
  f->said = said(f, goal, u_next);
  if (poses) {
    ++f->missed;
  } else if (used || !POSE) {
    f->missed = 0;
  }
  return f->code;
}

int @NAME@_flight_sample(@NAME@_flight *f, const @real@ y[@UPPER@_N_Y], const unsigned char given[@UPPER@_N_Y],
                         const @real@ goal[4]) {
  @real@ u_next[@UPPER@_N_U];
  if (all_finite(goal, 4)) memcpy(f->goal, goal, sizeof f->goal);
  stepped(f, y, given, f->goal, u_next);
  memcpy(f->u, u_next, sizeof f->u);
  return f->code;
}

int @NAME@_flight_watch(@NAME@_flight *f, const @real@ y[@UPPER@_N_Y], const unsigned char given[@UPPER@_N_Y],
                        const @real@ u[@UPPER@_N_U]) {
  @real@ none[@UPPER@_N_U];
  if (all_finite(u, @UPPER@_N_U)) memcpy(f->u, u, sizeof f->u);
  return stepped(f, y, given, 0, none);
}

int @NAME@_flight_ahead(@NAME@_flight *f, int samples, @real@ y[@UPPER@_N_Y]) {
  @real@ x[@UPPER@_N_X], x_next[@UPPER@_N_X];
  int k, code;
  memcpy(x, f->x, sizeof x);
  /* the estimate is one sample ahead already */
  for (k = 1; k < samples; ++k) {
    code = @NAME@_eval_f_d(x, f->u, f->p, x_next, &f->work);
    if (code > @UPPER@_OUT_OF_RANGE) return code;
    memcpy(x, x_next, sizeof x);
  }
  return @NAME@_eval_h(x, f->u, f->p, y, &f->work);
}
