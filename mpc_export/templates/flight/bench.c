/* A recording against the predictions, on any computer, before the first flight. Every line of the standard input is one
   sample of a flight that somebody else flew, numbers between spaces or commas, nan where nothing was measured:

       y (@n_y@: @outputs@)
       u (@n_u@: @inputs@), what was commanded from this sample to the next@given@

   in the model's units and order (@NAME@_model.h). Commands are told in every line. What follows them is told in the first
   and stays until another number above 0. It gives one line: the code, and what was predicted of y. At the end the
   standard error says per innovation its root mean square after the first FLIGHT_LASTING samples, and what the model states
   of it. Code 2:

   - a line has another number of numbers, or does not tell what acted;
   - nothing was judged, or what was measured was refused every time;
   - the flight does not tell the commands: with two of them exchanged, or one at its mean throughout, no innovation is
     more than CLEAR times what the model states and CLEAR times what it was.

       cc -std=c99 -O2 -o bench @NAME@_bench.c @NAME@_flight.c @NAME@_model.c @NAME@.c -lm
       ./bench < recording.csv > predicted.txt

   `./bench pilot` is no such check: a line has the goal (x y z heading) in place of what acted, and the line that it gives
   has the pilot's own command after the code. It predicts as if that command had flown. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "@NAME@_flight.h"

#define GIVEN @n_given@
#define MOST (@UPPER@_N_Y + @UPPER@_N_U + 4 + GIVEN)

#define WIDTH (@UPPER@_N_Y + @UPPER@_N_U + GIVEN)
#define CLEAR 2

typedef struct {
  @NAME@_flight flight;
  double squares[@UPPER@_N_E];
  long judged[@UPPER@_N_E], measured[@UPPER@_N_E];
} run;

static run flown, other;
/* rows of p that a line tells */
static const int given_rows[GIVEN + 1] = {@given_rows@0};
static const char *const names[@UPPER@_N_E] = {@innovations@};
static const char *const commands[@UPPER@_N_U] = {@commanded@};
static const unsigned char columns[@UPPER@_N_E][@UPPER@_N_Y] = {
@columns@
};
@spread@

/* How many numbers a line has; -1 for what is none. */
static int numbers(char *line, double *row) {
  char *at = line, *end;
  int n = 0;
  for (;;) {
    at += strspn(at, " \t\r\n,;");
    if (!*at) return n;
    if (n == MOST) return -1;
    row[n++] = strtod(at, &end);
    if (end == at) return -1;
    at = end;
  }
}

/* Whether a line tells what acted: nothing may stand in for what flew. */
static int acted(const double *told, int first) {
  int i;
  for (i = 0; i < @UPPER@_N_U; ++i) {
    if (told[i] - told[i] != 0) return 0;
  }
  for (i = 0; first && i < GIVEN; ++i) {
    if (!(told[@UPPER@_N_U + i] > 0) || told[@UPPER@_N_U + i] - told[@UPPER@_N_U + i] != 0) return 0;
  }
  return 1;
}

/* Only what was measured and used is judged: what was refused has no innovation. */
static void judge(run *r, const unsigned char *there) {
  int i, k, whole;
  for (i = 0; i < @UPPER@_N_E; ++i) {
    whole = 1;
    for (k = 0; k < @UPPER@_N_Y; ++k) whole = whole && (!columns[i][k] || there[k]);
    if (!whole) continue;
    ++r->measured[i];
    if (!r->flight.used[i]) continue;
    r->squares[i] += (double)r->flight.e[i] * (double)r->flight.e[i];
    ++r->judged[i];
  }
}

static double rms(const run *r, int i) { return r->judged[i] ? sqrt(r->squares[i] / (double)r->judged[i]) : 0; }

/* One sample: measurements and what else its line tells, with a goal or the commands that flew. */
static void stepped(run *r, const double *row, const double *told, long sample, int pilot) {
  const double *given = row + @UPPER@_N_Y + @UPPER@_N_U;
  @real@ y[@UPPER@_N_Y], own[@UPPER@_N_U + 4];
  unsigned char there[@UPPER@_N_Y];
  int i;
  for (i = 0; i < @UPPER@_N_Y; ++i) {
    y[i] = (@real@)row[i];
    there[i] = row[i] - row[i] == 0;
  }
  for (i = 0; i < (pilot ? 4 : @UPPER@_N_U); ++i) own[i] = (@real@)told[i];
  if (!sample) {
    /* without a place it starts from the first pose, if the model measures one */
    const @real@ place = (@real@)strtod("@nowhere@", 0), at[4] = {place, place, place, place};
    @NAME@_flight_start(&r->flight, pilot ? own : at);
  }
  for (i = 0; !pilot && i < GIVEN; ++i) @NAME@_flight_parameter(&r->flight, given_rows[i], (@real@)given[i]);
  if (pilot) {
    @NAME@_flight_sample(&r->flight, y, there, own);
    return;
  }
  @NAME@_flight_watch(&r->flight, y, there, own);
  if (sample >= @UPPER@_FLIGHT_LASTING) judge(r, there);
}

/* Whether the same flight with the commands i and j exchanged, or i at its mean, looks clearly worse. */
static int tells(const double *rows, long samples, int i, int j) {
  double u[@UPPER@_N_U], mean = 0;
  long k;
  int e;
  memset(&other, 0, sizeof other);
  for (k = 0; k < samples; ++k) mean += rows[k * WIDTH + @UPPER@_N_Y + i] / (double)samples;
  for (k = 0; k < samples; ++k) {
    const double *row = rows + k * WIDTH;
    memcpy(u, row + @UPPER@_N_Y, sizeof u);
    u[i] = i == j ? mean : row[@UPPER@_N_Y + j];
    if (i != j) u[j] = row[@UPPER@_N_Y + i];
    stepped(&other, row, u, k, 0);
  }
  for (e = 0; e < @UPPER@_N_E; ++e) {
    const double least = CLEAR * fmax(rms(&flown, e), (double)spread[e]);
    if (flown.judged[e] && (!other.judged[e] || rms(&other, e) > least)) return 1;
  }
  return 0;
}

static int told_apart(const double *rows, long samples) {
  int i, j, all = 1;
  for (i = 0; i < @UPPER@_N_U; ++i) {
    for (j = i; j < @UPPER@_N_U; ++j) {
      if (tells(rows, samples, i, j)) continue;
      all = 0;
      if (i == j) fprintf(stderr, "this flight does not tell %s from its mean\n", commands[i]);
      if (i != j) fprintf(stderr, "this flight does not tell %s from %s\n", commands[i], commands[j]);
    }
  }
  if (!all) fprintf(stderr, "large motions about every axis tell them apart, if they are in the right order\n");
  return all;
}

static int said(const double *rows, long samples) {
  int i, any = 0, never = 0;
  for (i = 0; i < @UPPER@_N_E; ++i) {
    if (flown.measured[i] && !flown.judged[i]) {
      never = 1;
      fprintf(stderr, "%s: measured, and refused every time\n", names[i]);
    }
    if (!flown.judged[i]) continue;
    any = 1;
    fprintf(stderr, "%s: rms %.3g, the model states %.3g: %.2f times\n", names[i], rms(&flown, i), (double)spread[i],
            rms(&flown, i) / (double)spread[i]);
  }
  fprintf(stderr, "%lu samples failed, %lu with a measurement refused%s\n", flown.flight.failures, flown.flight.refused,
          any ? "" : "; nothing was judged");
  return any && told_apart(rows, samples) && !never ? 0 : 2;
}

/* Keeps a line for the flights that are compared with. Returns 0 without memory for it. */
static int kept(double **rows, long sample, const double *row) {
  double *more = *rows;
  if (!(sample & (sample - 1))) more = (double *)realloc(*rows, (size_t)(sample ? 2 * sample : 1) * WIDTH * sizeof *row);
  if (!more) return 0;
  *rows = more;
  memcpy(more + sample * WIDTH, row, WIDTH * sizeof *row);
  return 1;
}

int main(int count, char **words) {
  static char line[65536];
  double row[MOST], *rows = 0;
  const int pilot = count == 2 && !strcmp(words[1], "pilot");
  const int wanted = @UPPER@_N_Y + (pilot ? 4 : @UPPER@_N_U + GIVEN);
  long sample = 0;
  int i, code;
  if (count > 1 && !pilot) {
    fprintf(stderr, "%s: what is %s? nothing, or pilot\n", words[0], words[1]);
    return 2;
  }
  while (fgets(line, sizeof line, stdin)) {
    const double *told = row + @UPPER@_N_Y;
    const int n = numbers(line, row);
    if (n == 0) continue;
    if (n != wanted) {
      fprintf(stderr, "line %ld: expected %d numbers\n", sample + 1, wanted);
      return 2;
    }
    if (!pilot && !acted(told, !sample)) {
      fprintf(stderr, "line %ld: what acted is not told\n", sample + 1);
      return 2;
    }
    if (!pilot && !kept(&rows, sample, row)) {
      fprintf(stderr, "line %ld: no memory is left\n", sample + 1);
      return 2;
    }
    stepped(&flown, row, told, sample++, pilot);
    printf("%d", flown.flight.code);
    for (i = 0; pilot && i < @UPPER@_N_U; ++i) printf(" %.17g", (double)flown.flight.u[i]);
    for (i = 0; i < @UPPER@_N_Y; ++i) printf(" %.17g", (double)flown.flight.y_hat[i]);
    printf("\n");
  }
  code = pilot ? 0 : said(rows, sample);
  free(rows);
  return code;
}
