/* Writes a tape (tape.py) from the instructions of a CasADi function. Value k is what instruction k makes. */

#include <stdlib.h>

/* As in tape.py. */
enum { END, INPUT, OUTPUT, CONST, ASSIGN, ADD, SUB, MUL, DIV, MUL_ADD, MUL_SUB, SUB_MUL };
enum { NOTHING = -1 };

/* A value that stays, and what it is ordered by. */
typedef struct {
  int part, level, code, value;
} kept;

static int before(const void *one, const void *other) {
  const kept *a = one, *b = other;
  if (a->part != b->part) return a->part - b->part;
  if (a->level != b->level) return a->level - b->level;
  if (a->code != b->code) return a->code - b->code;
  return a->value - b->value;
}

/* The values that instructions take, three each, from the `held` places in which CasADi keeps them; how often each is
   taken. */
static void connect(int n, const int *code, const int *made, const int *given, int *place, int *operand, int *uses) {
  for (int k = 0; k < n; ++k) {
    int *own = operand + 3 * k;
    own[0] = own[1] = own[2] = NOTHING;
    if (code[k] != INPUT && code[k] != CONST)
      for (int i = 0; i < 2 && given[2 * k + i] != NOTHING; ++i) ++uses[own[i] = place[given[2 * k + i]]];
    if (code[k] != OUTPUT) place[made[2 * k]] = k;
  }
}

/* Take products into the sums that alone use them. */
static void fuse(int n, int *code, int *operand, const int *uses) {
  for (int k = 0; k < n; ++k) {
    int *own = operand + 3 * k;
    if (code[k] != ADD && code[k] != SUB) continue;
    for (int i = 0; i < 2; ++i) {
      const int product = own[i], other = own[1 - i];
      if (code[product] != MUL || uses[product] != 1) continue;
      code[k] = code[k] == ADD ? MUL_ADD : i ? SUB_MUL : MUL_SUB;
      own[0] = operand[3 * product], own[1] = operand[3 * product + 1], own[2] = other;
      code[product] = NOTHING;
      break;
    }
  }
}

/* Values in an order in which many neighbours within a `chunk` are made alike, so that the processor guesses right which
   instruction comes next. Gives how many there are. */
static int order(int n, int chunk, const int *code, const int *operand, int *level, kept *found) {
  int many = 0;
  for (int k = 0; k < n; ++k) {
    if (code[k] == NOTHING) continue;
    for (int i = 0; i < 3; ++i) {
      const int v = operand[3 * k + i];
      if (v != NOTHING && v / chunk == k / chunk && level[v] >= level[k]) level[k] = level[v] + 1;
    }
    found[many++] = (kept){k / chunk, level[k], code[k], k};
  }
  qsort(found, many, sizeof(kept), before);
  return many;
}

/* n instructions: `code` (n), fused in place; `made` and `given` (n, 2) as CasADi says, -1 for none, but for constants
   which one is given, of a function that holds its values in `held` places. Gives the number of `rows` (n + 1, 6), or -1
   without memory; `slots` is how many they need. */
int gb_write_tape(int n, int held, int chunk, int *code, const int *made, const int *given, unsigned short *rows,
                  int *slots) {
  int *memory = calloc(held + 8 * (size_t)n + 1, sizeof(int));
  kept *found = malloc((n + 1) * sizeof(kept));
  if (!memory || !found) {
    free(memory), free(found);
    return -1;
  }
  int *place = memory, *uses = place + held, *level = uses + n, *last = level + n, *slot = last + n, *unused = slot + n,
      *operand = unused + n, many, some = 0;
  connect(n, code, made, given, place, operand, uses);
  fuse(n, code, operand, uses);
  many = order(n, chunk, code, operand, level, found);
  for (int k = 0; k < n; ++k) last[k] = NOTHING;
  for (int j = 0; j < many; ++j)
    for (int i = 0; i < 3; ++i)
      if (operand[3 * found[j].value + i] != NOTHING) last[operand[3 * found[j].value + i]] = j;
  *slots = 0;
  for (int j = 0; j < many; ++j) {
    const int k = found[j].value, *own = operand + 3 * k;
    unsigned short *row = rows + 6 * j;
    row[0] = code[k];
    for (int i = 0; i < 3; ++i) row[2 + i] = own[i] == NOTHING ? 0 : slot[own[i]];
    row[5] = 0;
    for (int i = 0; i < 3; ++i)
      if (own[i] != NOTHING && last[own[i]] == j) {
        unused[some++] = slot[own[i]];
        last[own[i]] = NOTHING; /* it is given back once */
      }
    if (code[k] == OUTPUT) {
      row[1] = made[2 * k], row[3] = made[2 * k + 1];
      continue;
    }
    slot[k] = some ? unused[--some] : (*slots)++;
    row[1] = slot[k];
    if (last[k] == NOTHING) unused[some++] = slot[k]; /* nobody asks for it */
    if (code[k] == INPUT || code[k] == CONST) row[2] = given[2 * k], row[3] = given[2 * k + 1];
  }
  for (int i = 0; i < 6; ++i) rows[6 * many + i] = END;
  free(memory), free(found);
  return many + 1;
}
