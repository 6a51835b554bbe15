// How to use @n@ from C++: one second of flight at the reference command, then its linearisation.
#include "@n@_model.h"

#include <array>
#include <cstdio>

int main() {
  static @n@_work work;  // one per thread
  std::array<@n@_real, @up@_N_X> x{}, next{};
  std::array<@n@_real, @up@_N_D * @up@_N_D> a{};
  std::array<@n@_real, @up@_N_D * @up@_N_U> b{};
  for (int i = 0; i < @up@_N_X; ++i) x[i] = @n@_x_reference[i];
  const @n@_real *u = @n@_u_reference, *p = @p@;
  for (int k = 0; k * @up@_SAMPLE_TIME < 1.0; ++k) {
    const int code = @n@_eval_f_d(x.data(), u, p, next.data(), &work);
    if (code > @up@_OUT_OF_RANGE) return code;
    x = next;
  }
  const int code = @n@_eval_f_d_jac(x.data(), u, p, next.data(), a.data(), b.data(), nullptr, &work);
  std::printf("x[0] = %g after one second, A[0][0] = %g\n", double(x[0]), double(a[0]));
  return code > @up@_OUT_OF_RANGE ? code : 0;
}
