/* A flight of @samples@ samples against the commands that Python gave, damaged measurements among them.

       mkdir -p build
       cc -O2 -o build/selftest @NAME@_tube_selftest.c @NAME@_tube.c @NAME@_tube_model.c @NAME@_tube_filter.c -lm
       build/selftest

   Prints the largest difference and what the calls said; exit code 1 where it is beyond @tolerance@, or a command beyond
   its limits. */
#include <math.h>
#include <stdio.h>

#include "@NAME@_tube.h"

#define SAMPLES @samples@
#define NY @UPPER@_TUBE_N_Y
#define NU @UPPER@_TUBE_N_U

static const struct {
  unsigned bit;
  const char *meaning;
} bits[] = {
  {@UPPER@_TUBE_NOT_STARTED, "NOT_STARTED: there was no start"},
  {@UPPER@_TUBE_NO_MEASUREMENT, "NO_MEASUREMENT: the filter predicts"},
  {@UPPER@_TUBE_DOUBTED, "DOUBTED: a measurement counts in part"},
  {@UPPER@_TUBE_NOT_BELIEVED, "NOT_BELIEVED: a measurement does not count"},
  {@UPPER@_TUBE_FILTER_FAILED, "FILTER_FAILED: its estimate was not finite"},
  {@UPPER@_TUBE_FILTER_ANEW, "FILTER_ANEW: it began again at what is measured"},
  {@UPPER@_TUBE_CALLS_MISSED, "CALLS_MISSED: the filter predicts over the gap"},
  {@UPPER@_TUBE_CLOCK, "CLOCK: the time that has passed is no time"},
  {@UPPER@_TUBE_NO_SOLUTION, "NO_SOLUTION: a safe command instead of a plan's"},
  {@UPPER@_TUBE_NOT_BEST, "NOT_BEST: the plan's QP was cut off"},
  {@UPPER@_TUBE_CLIPPED, "CLIPPED: limits moved commands of the plan"},
  {@UPPER@_TUBE_BEYOND_LIMITS, "BEYOND_LIMITS: limits moved the command"},
  {@UPPER@_TUBE_WEAK, "WEAK: no steady command holds the place"},
  {@UPPER@_TUBE_BLIND, "BLIND: no pose for too long"},
  {@UPPER@_TUBE_FAR_FROM_HOVER, "FAR_FROM_HOVER: too tilted or fast for the linear plan"},
  {@UPPER@_TUBE_NOT_TOLD, "NOT_TOLD: a run-time parameter is not known"},
  {@UPPER@_TUBE_REFUSED, "REFUSED: a told parameter cannot be used"},
  {@UPPER@_TUBE_UNTRAINED, "UNTRAINED: a parameter beyond its training range"},
  {@UPPER@_TUBE_SLACK, "SLACK: the plan does not hold a limit"},
  {@UPPER@_TUBE_HEAVY, "HEAVY: pushed down by a third of the weight"}};

@data@

int main(void) {
  static @NAME@_tube_path path[@UPPER@_TUBE_STAGES + 1];
  @real@ u[NU], before[NU], worst = 0;
  unsigned times[sizeof bits / sizeof *bits] = {0};
  int outside = 0, failed;
  if (!@NAME@_tube_start(place)) {
    printf("@NAME@_tube: it did not start: FAILED\n");
    return 1;
  }
  for (int k = 0; k <= @UPPER@_TUBE_STAGES; k++) {
    for (int i = 0; i < 3; i++) path[k].position[i] = goal[i];
    path[k].yaw = goal[3];
  }
  for (int k = 0; k < SAMPLES; k++) {
    unsigned char given[NY];
    for (int i = 0; i < NY; i++) given[i] = measured[k][i] - measured[k][i] == 0;
    for (int i = 0; i < @UPPER@_TUBE_N_P; i++) @NAME@_tube_parameter(i, told[i]);
    unsigned said = @NAME@_tube_step(@sample@, measured[k], given, path, 0, u);
    for (unsigned i = 0; i < sizeof bits / sizeof *bits; i++) times[i] += (said & bits[i].bit) != 0;
    for (int i = 0; i < NU; i++) {
      @real@ off = u[i] - wanted[k][i];
      off = off < 0 ? -off : off;
      if (!(off <= worst)) worst = off;
      if (!(u[i] >= lowest && u[i] <= highest)) outside++;
      if (k > 0 && !(u[i] - before[i] <= rate && before[i] - u[i] <= rate)) outside++;
      before[i] = u[i];
    }
  }
  failed = !(worst <= @tolerance@) || outside > 0;
  printf("@NAME@_tube: %d samples, commands differ from @whose@ by %g at most (limit %g), %d beyond their limits: %s\n",
         SAMPLES, (double)worst, (double)@tolerance@, outside, failed ? "FAILED" : "passed");
  printf("what its calls said, of a recording with a gap of 4 samples and a spike:\n");
  for (unsigned i = 0; i < sizeof bits / sizeof *bits; i++)
    if (times[i] > 0) printf("  %2u samples  %s\n", times[i], bits[i].meaning);
  return failed;
}
