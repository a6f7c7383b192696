/* A dense decision transformer in int8, as core/engine/dense/integer_dense_pass.cc computes it,
   with the tables of dense_baseline.cc. Prints in hexadecimal: the hash of the logits, the mean and the
   most instructions of a decision, the bytes of the stack, and those of the state. */
#ifndef DENSE_PAIRS
#define DENSE_PAIRS 0 /* dense_pairs.c has 1 */
#endif

#include <stdint.h>
#include <string.h>

#if DENSE_PAIRS && defined(__ARM_FEATURE_SIMD32)
#include <arm_acle.h>
#endif

#include "port.h"

typedef struct {
  const int8_t *weight, *shift; /* [outputs][inputs], [outputs] */
  const int16_t* bias;          /* [outputs] */
  int inputs, outputs;
} dense_map;

typedef struct {
  const int16_t *weight, *bias;
  int shift;
} dense_norm;

typedef struct {
  dense_map map;
  dense_norm norm;
} dense_embedding;

typedef struct {
  dense_map query, key, value, attention_output, ffn_hidden, ffn_output;
  dense_norm attention_norm, ffn_norm;
} dense_layer;

#include "dense_tables.h"

#define SLOTS (3 * DENSE_CONTEXT)
#define WIDEST (DENSE_FFN > DENSE_HIDDEN ? DENSE_FFN : DENSE_HIDDEN)
#define INPUTS (DENSE_OBSERVATIONS * (1 + DENSE_CHANGES))

/* Numbers of 8 bits by head, and the exponents of the heads. */
typedef struct {
  int8_t numbers[DENSE_HIDDEN];
  uint8_t exponent[DENSE_HEADS];
} dense_heads;

static struct {
  dense_heads keys[DENSE_LAYERS][SLOTS], values[DENSE_LAYERS][SLOTS], query;
  int32_t x[DENSE_HIDDEN], y[WIDEST], weights[SLOTS];
  int8_t block[WIDEST];
  float previous[DENSE_OBSERVATIONS];
  uint32_t timestep;
} state;

static int32_t round_shift(int32_t a, int s) {
  return s <= 0 ? a * ((int32_t)1 << -s) : (a + ((int32_t)1 << (s - 1))) >> s;
}

static int32_t limit(int32_t a, int32_t low, int32_t high) {
  return a < low ? low : a > high ? high : a;
}

static int bits_of(uint32_t a) {
  int bits = 0;
  while (a != 0) {
    a >>= 1;
    ++bits;
  }
  return bits;
}

/* Rounds numbers to 8 bits with a common exponent, which it returns. */
static int round_block(const int32_t* x, int size, int8_t* block) {
  uint32_t largest = 0;
  int k, exponent;
  for (k = 0; k < size; ++k) {
    const uint32_t magnitude = (uint32_t)(x[k] < 0 ? -x[k] : x[k]);
    if (magnitude > largest) largest = magnitude;
  }
  exponent = bits_of(largest) - 7;
  if (exponent < 0) exponent = 0;
  for (k = 0; k < size; ++k) block[k] = (int8_t)limit(round_shift(x[k], exponent), -127, 127);
  return exponent;
}

static int32_t dot_of(const int8_t* a, const int8_t* b, int size) {
  int32_t sum = 0;
#if DENSE_PAIRS && defined(__ARM_FEATURE_SIMD32)
  for (; size >= 4; size -= 4, a += 4, b += 4) { /* two products in an instruction */
    uint32_t x, y;
    memcpy(&x, a, 4);
    memcpy(&y, b, 4);
    sum = __smlad(__sxtb16(x), __sxtb16(y), sum);
    sum = __smlad(__sxtb16(x >> 8), __sxtb16(y >> 8), sum);
  }
#endif
  while (size-- > 0) sum += *a++ * *b++;
  return sum;
}

/* Sets state.y to the outputs of a map for state.block. */
static void apply(const dense_map* map, int exponent) {
  int k;
  for (k = 0; k < map->outputs; ++k) {
    const int32_t sum = dot_of(map->weight + k * map->inputs, state.block, map->inputs);
    state.y[k] = limit(round_shift(sum, map->shift[k] - exponent) + map->bias[k], -32767, 32767);
  }
}

static void apply_heads(const dense_map* map, int exponent, dense_heads* heads) {
  int h;
  apply(map, exponent);
  for (h = 0; h < DENSE_HEADS; ++h) {
    heads->exponent[h] = (uint8_t)round_block(state.y + h * DENSE_HEAD_SIZE, DENSE_HEAD_SIZE,
                                              heads->numbers + h * DENSE_HEAD_SIZE);
  }
}

static int32_t round_divide(int32_t a, int32_t b) {
  const int32_t dividend = 2 * a + b;
  return dividend / (2 * b) - (dividend % (2 * b) < 0);
}

static uint32_t root(uint32_t a) {
  uint32_t result = 0, bit;
  for (bit = (uint32_t)1 << 30; bit != 0; bit >>= 2) {
    if (a >= result + bit) {
      a -= result + bit;
      result = (result >> 1) + bit;
    } else {
      result >>= 1;
    }
  }
  return result;
}

static void normalise(const dense_norm* norm) {
  int32_t sum = 0, mean, inverse = 0;
  uint64_t squares = 0;
  int bits = 0, e = 0, k;
  for (k = 0; k < DENSE_HIDDEN; ++k) sum += state.x[k] = limit(state.x[k], -32767, 32767);
  mean = round_divide(sum, DENSE_HIDDEN);
  for (k = 0; k < DENSE_HIDDEN; ++k) {
    const int32_t c = state.x[k] -= mean;
    squares += (uint32_t)(c < 0 ? -c : c) * (uint64_t)(uint32_t)(c < 0 ? -c : c);
  }
  while (bits < 64 && squares >> bits != 0) ++bits;
  if (squares != 0) {
    e = (bits - 31) >> 1;
    inverse = (int32_t)(((uint32_t)1 << 30) /
                        root((uint32_t)(e > 0 ? squares >> (2 * e) : squares << (-2 * e))));
  }
  for (k = 0; k < DENSE_HIDDEN; ++k) {
    const int32_t u = round_shift(round_shift(state.x[k], e) * inverse, 15);
    state.x[k] =
        limit(round_shift(u * norm->weight[k], norm->shift) + norm->bias[k], -32767, 32767);
  }
}

static void add(const dense_norm* norm) {
  int k;
  for (k = 0; k < DENSE_HIDDEN; ++k) state.x[k] += state.y[k];
  normalise(norm);
}

/* Sets state.y to the attention of a token. Its timestep has tokens up to `kind`. */
static void attend(int layer, int kind) {
  const uint32_t t = state.timestep;
  const uint32_t first = t + 1 > DENSE_CONTEXT ? t + 1 - DENSE_CONTEXT : 0;
  const int n = 3 * (int)(t - first) + kind + 1;
  int h, i, k;
  for (h = 0; h < DENSE_HEADS; ++h) {
    const int8_t* query = state.query.numbers + h * DENSE_HEAD_SIZE;
    int32_t sums[DENSE_HEAD_SIZE], total = 0;
    int32_t best = INT32_MIN;
    for (i = 0; i < n; ++i) {
      const dense_heads* key = &state.keys[layer][(3 * first + (uint32_t)i) % SLOTS];
      const int32_t dot = dot_of(query, key->numbers + h * DENSE_HEAD_SIZE, DENSE_HEAD_SIZE);
      state.weights[i] = round_shift(
          dot * DENSE_SCALE, 2 * DENSE_FRACTION + 2 - state.query.exponent[h] - key->exponent[h]);
      if (state.weights[i] > best) best = state.weights[i];
    }
    for (k = 0; k < DENSE_HEAD_SIZE; ++k) sums[k] = 0;
    for (i = 0; i < n; ++i) {
      const dense_heads* value = &state.values[layer][(3 * first + (uint32_t)i) % SLOTS];
      const int8_t* numbers = value->numbers + h * DENSE_HEAD_SIZE;
      const uint32_t octaves = (uint32_t)(best - state.weights[i]);
      int32_t weight =
          octaves >= 4096 ? 0 : (int32_t)((65536 - 128 * (octaves & 255)) >> (octaves >> 8)) >> 8;
      if (weight > 255) weight = 255;
      total += weight;
      weight *= (int32_t)1 << value->exponent[h];
      for (k = 0; k < DENSE_HEAD_SIZE; ++k) sums[k] += weight * numbers[k];
    }
    for (k = 0; k < DENSE_HEAD_SIZE; ++k) {
      state.y[h * DENSE_HEAD_SIZE + k] = limit(round_divide(sums[k], total), -32767, 32767);
    }
  }
}

static void feed_forward(const dense_layer* w) {
  int k;
  apply(&w->ffn_hidden, round_block(state.x, DENSE_HIDDEN, state.block));
  for (k = 0; k < DENSE_FFN; ++k) {
    const int32_t x = state.y[k], index = round_shift(x < 0 ? -x : x, DENSE_FRACTION - 5);
    state.y[k] = (x > 0 ? x : 0) - (index < 128 ? gelu[index] : 0);
  }
  apply(&w->ffn_output, round_block(state.y, DENSE_FFN, state.block));
  add(&w->ffn_norm);
}

static void run_token(int kind, const dense_embedding* embedding, const float* input) {
  const dense_map* map = &embedding->map;
  const float whole = 12582912.0f; /* adding it rounds to an integer */
  const uint32_t slot = (3 * state.timestep + (uint32_t)kind) % SLOTS;
  int16_t rounded[INPUTS > DENSE_ACTIONS ? INPUTS : DENSE_ACTIONS];
  int layer, j, k;
  for (j = 0; j < map->inputs; ++j) {
    const float scaled = input[j] * (float)DENSE_INPUT_UNIT;
    const float limited = scaled < -32767.0f ? -32767.0f : scaled > 32767.0f ? 32767.0f : scaled;
    rounded[j] = (int16_t)(limited + whole - whole);
  }
  for (k = 0; k < DENSE_HIDDEN; ++k) {
    int32_t sum = 0;
    for (j = 0; j < map->inputs; ++j) sum += map->weight[k * map->inputs + j] * rounded[j];
    state.x[k] = round_shift(sum, map->shift[k]) + map->bias[k] + timestep_embedding[k];
  }
  normalise(&embedding->norm);
  for (layer = 0; layer < DENSE_LAYERS; ++layer) {
    const dense_layer* w = &layers[layer];
    const int exponent = round_block(state.x, DENSE_HIDDEN, state.block);
    apply_heads(&w->key, exponent, &state.keys[layer][slot]);
    apply_heads(&w->value, exponent, &state.values[layer][slot]);
    if (layer + 1 == DENSE_LAYERS && kind != 1) return;
    apply_heads(&w->query, exponent, &state.query);
    attend(layer, kind);
    apply(&w->attention_output, round_block(state.y, DENSE_HIDDEN, state.block));
    add(&w->attention_norm);
    feed_forward(w);
  }
}

/* Decides: `action` is the one before, or null. */
static void decide(const float* action, float target, const float* observation, float* logits) {
  float input[INPUTS];
  int i, j;
  if (action != NULL) {
    run_token(2, &embed_action, action);
    ++state.timestep;
  }
  run_token(0, &embed_return, &target);
  for (i = 0; i < DENSE_OBSERVATIONS; ++i) {
    input[i] = observation[i];
    if (DENSE_CHANGES)
      input[INPUTS - DENSE_OBSERVATIONS + i] =
          action == NULL ? 0.0f : observation[i] - state.previous[i];
    state.previous[i] = observation[i];
  }
  run_token(1, &embed_state, input);
  for (i = 0; i < DENSE_ACTIONS; ++i) {
    float z = head_bias[i];
    for (j = 0; j < DENSE_HIDDEN; ++j)
      z += head_weight[i * DENSE_HIDDEN + j] * ((float)state.x[j] / (1 << DENSE_FRACTION));
    logits[i] = z;
  }
}

static void print_number(uint64_t number, const char* after) {
  char text[17];
  int i;
  for (i = 0; i < 16; ++i) text[i] = "0123456789abcdef"[number >> (60 - 4 * i) & 15];
  text[16] = 0;
  port_print(text);
  port_print(after);
}

int main(void) {
  uint64_t hash = 0xcbf29ce484222325u, instructions = 0;
  uint32_t most = 0, decision;
  port_open();
  for (decision = 0; decision < DENSE_DECISIONS; ++decision) {
    float action[DENSE_ACTIONS], target, observation[DENSE_OBSERVATIONS], logits[DENSE_ACTIONS];
    uint32_t clock;
    size_t i;
    if (decision > 0) port_read(action, sizeof(action));
    port_read(&target, sizeof(target));
    port_read(observation, sizeof(observation));
    clock = port_clock();
    decide(decision > 0 ? action : NULL, target, observation, logits);
    clock = port_since(clock);
    instructions += clock;
    if (clock > most) most = clock;
    for (i = 0; i < sizeof(logits); ++i)
      hash = (hash ^ ((const uint8_t*)logits)[i]) * 0x100000001b3u;
  }
  print_number(hash, " ");
  print_number(instructions / DENSE_DECISIONS, " ");
  print_number(most, " ");
  print_number(port_stack(), " ");
  print_number(sizeof(state), "\n");
  port_exit(0);
  return 0;
}
