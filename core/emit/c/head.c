
/* From the readout to the action, and the energy: the only floating-point numbers. */

static int is_finite(double a) { return a - a == 0.0; }
static int is_float(double a) { return a >= -3.4028234663852886e38 && a <= 3.4028234663852886e38; }

/* Sets s->input from standardised numbers. */
static void round_input(spike_state* s, int index, float value) {
  const float whole = 12582912.0f; /* 1.5 * 2^23: adding it rounds to an integer, ties to even */
  value *= SPIKE_INPUT_UNIT;
  value = value < -32767.0f ? -32767.0f : value > 32767.0f ? 32767.0f : value;
  s->input[index] = (int16_t)(value + whole - whole);
}

/* Runs the tokens of a timestep. `previous` is the observation before; null: none. */
static void run_return_and_state(spike_state* s, uint32_t timestep, const spike_timestep* now,
                                 const float* previous, spike_costs* costs) {
  spike_token token = {0, 0};
  int i;
  token.timestep = timestep;
  round_input(s, 0, (now->return_to_go - SPIKE_RETURN_OFFSET) / SPIKE_RETURN_SCALE);
  run_token(s, token, &embed_return, costs);
  for (i = 0; i < SPIKE_OBSERVATIONS; ++i) {
    round_input(s, i, (now->observation[i] - observation_mean[i]) / observation_std[i]);
#if SPIKE_CHANGES
    round_input(s, SPIKE_OBSERVATIONS + i,
                previous == NULL ? 0.0f : (now->observation[i] - previous[i]) / change_std[i]);
#endif
  }
  (void)previous;
  token.kind = 1;
  run_token(s, token, &embed_state, costs);
}

static void run_action(spike_state* s, uint32_t timestep, const spike_action* action,
                       spike_costs* costs) {
  spike_token token = {0, 2};
  int i;
  token.timestep = timestep;
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
#if SPIKE_DISCRETE
    round_input(s, i, action->index == i ? 1.0f : 0.0f);
#else
    const double low = action_low[i], range = (double)action_high[i] - low;
    round_input(s, i, (float)(2.0 * (((double)action->value[i] - low) / range) - 1.0));
#endif
  }
  run_token(s, token, &embed_action, costs);
}

/* Sets s->logits from s->period, the readout's. */
static void run_head(spike_state* s, float* logits, spike_costs* costs) {
  int i, j;
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
    float z = head_bias[i];
    for (j = 0; j < SPIKE_HIDDEN; ++j) {
      const int count = s->period[j] == 0 ? 0 : SPIKE_TICKS / s->period[j];
      float w = head_weight[i * SPIKE_HIDDEN + j];
      if (s->has_delta) w += s->head_delta[i * SPIKE_HIDDEN + j];
      z += w * ((float)count / (float)SPIKE_TICKS);
    }
    logits[i] = z;
  }
  for (j = 0; j < SPIKE_HIDDEN; ++j) {
    if (s->period[j] != 0) costs->multiply_accumulates += head_nonzero[j];
  }
  costs->weight_bytes += 4 * SPIKE_ACTIONS * SPIKE_HIDDEN;
}

/* e^x with equal bits on every processor (core/math/exp.h). */
static float exponential(float x) {
  const float whole = 12582912.0f;
  float rounded, n, y;
  uint32_t bits;
  x = x < -87.0f ? -87.0f : x > 88.0f ? 88.0f : x;
  rounded = x * 1.44269504088896341f + whole;
  n = rounded - whole;
  x = x - n * 0.693359375f;
  x = x - n * -2.12194440e-4f;
  y = 1.9875691500e-4f;
  y = y * x + 1.3981999507e-3f;
  y = y * x + 8.3334519073e-3f;
  y = y * x + 4.1665795894e-2f;
  y = y * x + 1.6666665459e-1f;
  y = y * x + 5.0000001201e-1f;
  y = y * (x * x) + x + 1.0f;
  memcpy(&bits, &rounded, 4);
  bits = (bits - 0x4b400000u + 127) << 23;
  memcpy(&n, &bits, 4);
  return y * n;
}

#if SPIKE_DISCRETE
static void softmax(const float* logits, float temperature, float* probabilities) {
  float best = logits[0], sum = 0.0f;
  int i;
  for (i = 1; i < SPIKE_ACTIONS; ++i) best = logits[i] > best ? logits[i] : best;
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
    probabilities[i] = exponential((logits[i] - best) / temperature);
    sum += probabilities[i];
  }
  for (i = 0; i < SPIKE_ACTIONS; ++i) probabilities[i] /= sum;
}

/* Scrambles 64 bits (core/math/counter_random.h). */
static uint64_t mix(uint64_t x) {
  x += 0x9e3779b97f4a7c15u;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
  return x ^ (x >> 31);
}
#endif

static void choose(const spike_state* s, const float* logits, spike_action* action) {
  int i;
#if SPIKE_DISCRETE
  action->index = 0;
  if (s->temperature > 0.0f) {
    float probabilities[SPIKE_ACTIONS];
    const uint64_t bits = mix(mix(mix(mix(s->seed)) ^ mix(s->decisions)));
    const double draw = (double)(bits >> 11) * (1.0 / 9007199254740992.0);
    double cumulative = 0.0;
    softmax(logits, s->temperature, probabilities);
    for (i = 0; i + 1 < SPIKE_ACTIONS; ++i) {
      cumulative += (double)probabilities[i];
      if (draw < cumulative) break;
    }
    action->index = i;
    return;
  }
  for (i = 1; i < SPIKE_ACTIONS; ++i) {
    if (logits[i] > logits[action->index]) action->index = i;
  }
#else
  (void)s;
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
    const float unit = 1.0f - 2.0f / (exponential(2.0f * logits[i]) + 1.0f);
    const double low = action_low[i], high = action_high[i];
    const double value = low + 0.5 * ((double)unit + 1.0) * (high - low);
    action->value[i] = (float)(value < low ? low : value > high ? high : value);
  }
#endif
}

/* Energy of one decision in joules by horowitz_45nm, which the value of a session has. */
static double default_energy(const spike_costs* c) {
  const double picojoules =
      0.9 * (double)c->accumulates +
      (3.7 + 0.9) * ((double)((uint64_t)c->multiply_accumulates + c->membrane_updates +
                              c->coder_gains + c->gate_products)) +
      0.9 * (double)c->attention_products +
      (2 * 0.9 + 3.7 + 2 * (3.7 + 0.9)) * (double)c->layer_norm_elements +
      2 * (3.7 + 0.9) * (double)c->softmax_terms;
  return 1e-12 * picojoules;
}

/* Energies of one decision in joules by int_45nm and int_sram_45nm (core/engine/account.h). */
static void integer_energies(const spike_costs* c, double* operations, double* with_memory) {
  const uint32_t integers = c->integer_multiply_accumulates;
  const uint32_t counts[] = {
      c->accumulates,
      integers - c->wide_multiply_accumulates,
      c->wide_multiply_accumulates,
      c->multiply_accumulates - integers,
      c->membrane_updates,
      c->membrane_leaks,
      c->coder_gains,
      c->spikes[SPIKE_CODER] + c->spikes[SPIKE_FFN_IN] + c->spikes[SPIKE_READOUT],
      c->attention_products,
      c->attention_scalings,
      c->softmax_terms,
      c->gate_products,
      c->layer_norm_elements,
      c->membrane_updates + c->membrane_leaks +
          (SPIKE_NORMS ? 2 * c->layer_norm_elements : c->coder_gains)};
  const double bytes[] = {(double)c->weight_bytes, 4 * (double)c->driven_neurons,
                          (double)c->coder_gains * SPIKE_CODER_BYTES, (double)c->attention_bytes};
  double sum = 0.0, traffic = 0.0;
  size_t i;
  for (i = 0; i < sizeof(counts) / sizeof(counts[0]); ++i)
    sum += (double)counts[i] * operation_price[i];
  for (i = 0; i < 4; ++i) traffic += bytes[i] * byte_price[i];
  *operations = 1e-12 * sum;
  *with_memory = 1e-12 * (sum + traffic);
}
