/* A recording through the pilot, on any computer. Every line of the standard input is one sample:

       y (@n_y@ numbers, nan where it is not measured: @outputs@) x y z heading

   and gives one line: the code, the command in force until the next sample (@inputs@), and what was predicted of y.

       cc -std=c99 -O2 -o bench @NAME@_bench.c @NAME@_flight.c @NAME@_model.c @NAME@.c -lm */
#include <stdio.h>

#include "@NAME@_flight.h"

static @NAME@_flight flight;

int main(void) {
  double row[@UPPER@_N_Y + 4];
  int n = 0, begun = 0, i;
  while (scanf("%lf", &row[n]) == 1) {
    @real@ y[@UPPER@_N_Y], goal[4];
    unsigned char there[@UPPER@_N_Y];
    if (++n < @UPPER@_N_Y + 4) continue;
    n = 0;
    for (i = 0; i < @UPPER@_N_Y; ++i) {
      y[i] = (@real@)row[i];
      there[i] = row[i] - row[i] == 0;
    }
    for (i = 0; i < 4; ++i) goal[i] = (@real@)row[@UPPER@_N_Y + i];
    if (!begun) @NAME@_flight_start(&flight, goal);
    begun = 1;
    @NAME@_flight_sample(&flight, y, there, goal);
    printf("%d", flight.code);
    for (i = 0; i < @UPPER@_N_U; ++i) printf(" %.17g", (double)flight.u[i]);
    for (i = 0; i < @UPPER@_N_Y; ++i) printf(" %.17g", (double)flight.y_hat[i]);
    printf("\n");
  }
  return n != 0;
}
