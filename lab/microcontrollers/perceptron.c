/* A perceptron of two hidden layers of 64 in int8, as costs.py measures it beside a policy: the
   weights do not change its cost, so that these are any. Prints what chip_play.c prints. */
#include "port.h"
#include "spike_policy.h"

#define HIDDEN 64

static const int8_t first[HIDDEN][SPIKE_OBSERVATIONS] = {{1, -2}},
                    second[HIDDEN][HIDDEN] = {{-1, 2, -3}},
                    third[SPIKE_ACTIONS][HIDDEN] = {{3, -2, 1}};
static const int32_t first_bias[HIDDEN] = {1}, second_bias[HIDDEN] = {1},
                     third_bias[SPIKE_ACTIONS] = {1};
static volatile float observation[SPIKE_OBSERVATIONS] = {0.5f};

static void layer(const int8_t* weight, const int32_t* bias, const int8_t* input, int inputs,
                  int outputs, int8_t* output) {
  int k, j;
  for (k = 0; k < outputs; ++k) {
    int32_t sum = bias[k];
    for (j = 0; j < inputs; ++j) sum += *weight++ * input[j];
    sum = (sum + 64) >> 7;
    output[k] = (int8_t)(sum < 0 ? 0 : sum > 127 ? 127 : sum);
  }
}

int main(void) {
  int8_t input[SPIKE_OBSERVATIONS], a[HIDDEN], b[HIDDEN], output[SPIKE_ACTIONS];
  char text[] = "0 00000000 00000000 00000000\n";
  uint32_t clock;
  int i;
  port_open();
  clock = port_clock();
  for (i = 0; i < SPIKE_OBSERVATIONS; ++i) input[i] = (int8_t)(observation[i] * 16.0f);
  layer(&first[0][0], first_bias, input, SPIKE_OBSERVATIONS, HIDDEN, a);
  layer(&second[0][0], second_bias, a, HIDDEN, HIDDEN, b);
  layer(&third[0][0], third_bias, b, HIDDEN, SPIKE_ACTIONS, output);
  observation[0] = output[0];
  clock = port_since(clock);
  for (i = 0; i < 8; ++i) {
    text[2 + i] = text[11 + i] = "0123456789abcdef"[(clock >> (28 - 4 * i)) & 15];
    text[20 + i] = "0123456789abcdef"[(port_stack() >> (28 - 4 * i)) & 15];
  }
  port_print(text);
  port_exit(0);
  return 0;
}
