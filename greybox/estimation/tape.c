/* Runs a tape (tape.py) for several samples at once: every work slot holds one number per sample, in vectors of eight.

   Number j of argument i for sample l is arg[i * lanes' + l][j], lanes' = lanes rounded up to whole vectors; number j of
   result i goes to res[i][l * length[i] + j]. */

#include <math.h>

typedef double eight __attribute__((vector_size(64)));
typedef long long bits __attribute__((vector_size(64)));

/* Slot `to` becomes f of the slots a, b and c. INPUT: number b of argument a; OUTPUT: number b of result `to` is slot a;
   CONST: number a of the constants. */
typedef struct {
  unsigned short f, to, a, b, c, unused;
} instruction;

/* Whole vectors, and functions of the C library lane by lane; x, y and z stand for the slots a, b and c. */
#define VECTORS(DO)                                                                                                      \
  DO(ASSIGN, x) DO(ADD, x + y) DO(SUB, x - y) DO(MUL, x *y) DO(DIV, x / y) DO(MUL_ADD, x *y + z) DO(MUL_SUB, x *y - z)   \
  DO(SUB_MUL, z - x * y) DO(NEG, -x) DO(SQ, x *x) DO(TWICE, x + x) DO(INV, 1.0 / x) DO(LT, TRUE_WHERE(x < y))            \
  DO(LE, TRUE_WHERE(x <= y)) DO(EQ, TRUE_WHERE(x == y)) DO(NE, TRUE_WHERE(x != y)) DO(NOT, TRUE_WHERE(x == NOTHING))     \
  DO(AND, TRUE_WHERE((x != NOTHING) & (y != NOTHING))) DO(OR, TRUE_WHERE((x != NOTHING) | (y != NOTHING)))               \
  DO(IF_ELSE_ZERO, (eight)((x != NOTHING) & (bits)y))
#define LANES_OF(DO)                                                                                                     \
  DO(SQRT, sqrt(x)) DO(FABS, fabs(x)) DO(FMIN, fmin(x, y)) DO(FMAX, fmax(x, y)) DO(EXP, exp(x)) DO(LOG, log(x))          \
  DO(SIN, sin(x)) DO(COS, cos(x)) DO(TAN, tan(x)) DO(ASIN, asin(x)) DO(ACOS, acos(x)) DO(ATAN, atan(x))                  \
  DO(FLOOR, floor(x)) DO(CEIL, ceil(x)) DO(ERF, erf(x)) DO(SINH, sinh(x)) DO(COSH, cosh(x)) DO(TANH, tanh(x))            \
  DO(ASINH, asinh(x)) DO(ACOSH, acosh(x)) DO(ATANH, atanh(x)) DO(LOG1P, log1p(x)) DO(EXPM1, expm1(x))                    \
  DO(POW, pow(x, y)) DO(CONSTPOW, pow(x, y)) DO(FMOD, fmod(x, y)) DO(COPYSIGN, copysign(x, y))                           \
  DO(ATAN2, atan2(x, y)) DO(HYPOT, hypot(x, y)) DO(SIGN, x < 0 ? -1 : x > 0 ? 1 : x)

/* A short loop of a length that is known; -O3 writes out many more, and takes the compiler several times as long. */
#define WRITTEN_OUT _Pragma("GCC unroll 4")
#define NOTHING ((eight){0})
#define TRUE_WHERE(mask) __builtin_convertvector(-(mask), eight)
#define SLOT(i) (work + (long)(i) * WIDTH)
#define NEXT goto *place[(++s)->f]
#define PLACE(name, formula) &&L_##name,
#define ON_VECTORS(name, formula)                                                    \
  L_##name : {                                                                       \
    eight *to = SLOT(s->to);                                                         \
    const eight *px = SLOT(s->a), *py = SLOT(s->b), *pz = SLOT(s->c);                \
    WRITTEN_OUT for (int v = 0; v < WIDTH; ++v) {                                    \
      const eight x = px[v], y = py[v], z = pz[v];                                   \
      (void)y, (void)z;                                                              \
      to[v] = formula;                                                               \
    }                                                                                \
    NEXT;                                                                            \
  }
#define ON_LANES(name, formula)                                                      \
  L_##name : {                                                                       \
    double *to = (double *)SLOT(s->to);                                              \
    const double *px = (const double *)SLOT(s->a), *py = (const double *)SLOT(s->b); \
    for (int l = 0; l < 8 * WIDTH; ++l) {                                            \
      const double x = px[l], y = py[l];                                             \
      (void)y;                                                                       \
      to[l] = formula;                                                               \
    }                                                                                \
    NEXT;                                                                            \
  }

/* One function for every number of vectors in a slot, so that the loops over them are unrolled. */
#define RUN(name)                                                                                                        \
  static void name(const instruction *s, const double *constants, const double **arg, double **res,                      \
                   const long long *length, eight *work, int lanes) {                                                    \
    static const void *const place[] = {&&L_END, &&L_INPUT, &&L_OUTPUT, &&L_CONST, VECTORS(PLACE) LANES_OF(PLACE)};      \
    goto *place[s->f];                                                                                                   \
  L_INPUT : {                                                                                                            \
    double *to = (double *)SLOT(s->to);                                                                                  \
    for (int l = 0; l < 8 * WIDTH; ++l) to[l] = arg[s->a * 8 * WIDTH + l][s->b];                                         \
    NEXT;                                                                                                                \
  }                                                                                                                      \
  L_OUTPUT : {                                                                                                           \
    const double *from = (const double *)SLOT(s->a);                                                                     \
    const long long n = length[s->to];                                                                                   \
    double *to = res[s->to] + s->b;                                                                                      \
    for (int l = 0; l < lanes; ++l) to[l * n] = from[l];                                                                 \
    NEXT;                                                                                                                \
  }                                                                                                                      \
  L_CONST : {                                                                                                            \
    eight *to = SLOT(s->to);                                                                                             \
    WRITTEN_OUT for (int v = 0; v < WIDTH; ++v) to[v] = constants[s->a] + NOTHING;                                       \
    NEXT;                                                                                                                \
  }                                                                                                                      \
    VECTORS(ON_VECTORS) LANES_OF(ON_LANES)                                                                               \
  L_END:;                                                                                                                \
  }

#define WIDTH 1
RUN(one)
#undef WIDTH
#define WIDTH 2
RUN(two)
#undef WIDTH
#define WIDTH 4
RUN(four)
#undef WIDTH

/* The vectors that `lanes` samples take: 1, 2 or 4. */
int gb_tape_width(int lanes) { return lanes <= 8 ? 1 : lanes <= 16 ? 2 : 4; }

/* At most 32 samples. `work` holds 8 * gb_tape_width(lanes) numbers per slot and 8 more, in which its start is aligned. */
void gb_tape(const void *instructions, const double *constants, const double **arg, double **res, const long long *length,
             double *work, int lanes) {
  eight *slots = (eight *)(((unsigned long long)work + 63) & ~63ULL);
  const int width = gb_tape_width(lanes);
  (width == 1 ? one : width == 2 ? two : four)(instructions, constants, arg, res, length, slots, lanes);
}
