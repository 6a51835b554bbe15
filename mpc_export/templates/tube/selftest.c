/* A flight of @samples@ samples against the commands that Python gave, damaged measurements among them.

       cc -O2 -o selftest @NAME@_tube_selftest.c @NAME@_tube.c @NAME@_tube_model.c @NAME@_tube_filter.c -lm && ./selftest

   Prints the largest difference; exit code 1 where it is beyond @tolerance@, or a command beyond its limits. */
#include <math.h>
#include <stdio.h>

#include "@NAME@_tube.h"

#define SAMPLES @samples@
#define NY @UPPER@_TUBE_N_Y
#define NU @UPPER@_TUBE_N_U

@data@

int main(void) {
  static @NAME@_tube_path path[@UPPER@_TUBE_STAGES + 1];
  @real@ u[NU], before[NU], worst = 0;
  unsigned said = 0;
  int outside = 0;
  if (!@NAME@_tube_start(place)) return 1;
  for (int k = 0; k <= @UPPER@_TUBE_STAGES; k++) {
    for (int i = 0; i < 3; i++) path[k].position[i] = goal[i];
    path[k].yaw = goal[3];
  }
  for (int k = 0; k < SAMPLES; k++) {
    unsigned char given[NY];
    for (int i = 0; i < NY; i++) given[i] = measured[k][i] - measured[k][i] == 0;
    said |= @NAME@_tube_step(@sample@, measured[k], given, path, 0, u);
    for (int i = 0; i < NU; i++) {
      @real@ off = u[i] - wanted[k][i];
      off = off < 0 ? -off : off;
      if (!(off <= worst)) worst = off;
      if (!(u[i] >= lowest && u[i] <= highest)) outside++;
      if (k > 0 && !(u[i] - before[i] <= rate && before[i] - u[i] <= rate)) outside++;
      before[i] = u[i];
    }
  }
  printf("largest difference %g, outside %d, said %u\n", (double)worst, outside, said);
  return !(worst <= @tolerance@) || outside > 0;
}
