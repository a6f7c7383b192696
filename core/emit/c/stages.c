
static int32_t round_shift(int32_t a, int s) {
  return s <= 0 ? a * ((int32_t)1 << -s) : (a + ((int32_t)1 << (s - 1))) >> s;
}

/* REQUIRES: b > 0. */
static int32_t round_divide(int32_t a, int32_t b) {
  const int32_t dividend = 2 * a + b;
  return dividend / (2 * b) - (dividend % (2 * b) < 0);
}

static int32_t limit(int32_t a, int32_t low, int32_t high) {
  return a < low ? low : a > high ? high : a;
}

#if SPIKE_ROUTING
/* Returns 2^(16 - octaves / 256). */
static int32_t power_of_two(uint32_t octaves) {
  return octaves >= 4096 ? 0 : (int32_t)((65536 - 128 * (octaves & 255)) >> (octaves >> 8));
}
#endif

#if SPIKE_NORMS
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
#endif

static uint32_t ones(spike_word word) {
  uint32_t w = word;
  w -= (w >> 1) & 0x55555555u;
  w = (w & 0x33333333u) + ((w >> 2) & 0x33333333u);
  w = (w + (w >> 4)) & 0x0f0f0f0fu;
  return (w * 0x01010101u) >> 24;
}

/* Sets s->sums to the outputs of a map for s->input. Returns the products of nonzero numbers. */
static uint32_t apply_map(spike_state* s, const spike_map* map) {
  const int8_t* weight = map->weight;
  uint32_t products = 0;
  int j, k;
  for (k = 0; k < map->outputs; ++k) s->sums[k] = 0;
  for (j = 0; j < map->inputs; ++j, weight += map->outputs) {
    const int32_t input = s->input[j];
    if (input == 0) continue;
    products += map->nonzero[j];
    for (k = 0; k < map->outputs; ++k) s->sums[k] += weight[k] * input;
  }
  for (k = 0; k < map->outputs; ++k) {
    s->sums[k] = round_shift(s->sums[k], map->shift[k]) + map->bias[k];
  }
  return products;
}

static void count_map(spike_costs* costs, uint32_t products) {
  costs->multiply_accumulates += products;
  costs->integer_multiply_accumulates += products;
}

/* Replaces s->x by its norm. */
static void normalise(spike_state* s, const spike_norm* norm, spike_costs* costs) {
  int k;
  for (k = 0; k < SPIKE_HIDDEN; ++k) s->x[k] = limit(s->x[k], -32767, 32767);
#if SPIKE_NORMS
  {
    int32_t sum = 0, mean, inverse = 0;
    uint64_t squares = 0;
    int bits = 0, e = 0;
    for (k = 0; k < SPIKE_HIDDEN; ++k) sum += s->x[k];
    mean = round_divide(sum, SPIKE_HIDDEN);
    for (k = 0; k < SPIKE_HIDDEN; ++k) {
      const int32_t c = s->x[k] -= mean;
      squares += (uint32_t)(c < 0 ? -c : c) * (uint64_t)(uint32_t)(c < 0 ? -c : c);
    }
    while (bits < 64 && squares >> bits != 0) ++bits;
    if (squares != 0) {
      e = (bits - 31) >> 1;
      inverse = (int32_t)(((uint32_t)1 << 30) /
                          root((uint32_t)(e > 0 ? squares >> (2 * e) : squares << (-2 * e))));
    }
    for (k = 0; k < SPIKE_HIDDEN; ++k) {
      const int32_t u = round_shift(round_shift(s->x[k], e) * inverse, 15);
      s->x[k] = limit(round_shift(u * norm->weight[k], norm->shift) + norm->bias[k], -32767, 32767);
    }
  }
  costs->layer_norm_elements += SPIKE_HIDDEN;
#else
  (void)norm;
  (void)costs;
#endif
}

/* Adds a map of s->input to s->x, and normalises. Returns the products. */
static uint32_t add_map(spike_state* s, const spike_mapped* to, spike_costs* costs) {
  const uint32_t products = apply_map(s, &to->map);
  int k;
  for (k = 0; k < SPIKE_HIDDEN; ++k) s->x[k] += s->sums[k];
  count_map(costs, products);
  normalise(s, &to->norm, costs);
  return products;
}

/* Sets s->period to the periods of the neurons of a coder. */
static void code(spike_state* s, const spike_coder* coder, int stage, spike_costs* costs) {
  const int16_t* threshold = coder->threshold;
  int j, n;
  for (j = 0; j < SPIKE_HIDDEN; ++j, threshold += SPIKE_TICKS) {
    const int32_t x = coder->sign[j] * s->x[j];
    for (n = 1; n <= SPIKE_TICKS && x <= threshold[n - 1]; ++n) continue;
    s->period[j] = (uint8_t)(n > SPIKE_TICKS ? 0 : n);
    if (n <= SPIKE_TICKS) costs->spikes[stage] += (uint32_t)(SPIKE_TICKS / n);
  }
  costs->coder_gains += SPIKE_HIDDEN;
}

#if SPIKE_PHASES
static int phase_fires(int head, uint32_t timestep, int tick) {
  const uint32_t* p = phases[head];
  return p[0] + timestep * p[1] + (uint32_t)tick * p[2] < (uint32_t)1 << 31;
}
#endif

/* Sets s->drive[t] to the input current of each neuron at tick t, without the bias, and event[t] to
   whether an input neuron fires at it. Neurons of equal period are added once. */
static void drive(spike_state* s, const spike_population* p, int has_phase, uint32_t timestep,
                  uint8_t* event, spike_costs* costs) {
  const int outputs = p->outputs;
  const int8_t* weight = p->weight;
  uint32_t synapses = 0, rows = 0;
  int j, k, n, t;
  for (t = 0; t < SPIKE_TICKS; ++t) {
    event[t] = 0;
    for (k = 0; k < outputs; ++k) s->drive[t][k] = 0;
  }
  for (j = 0; j < SPIKE_HIDDEN; ++j, weight += outputs) {
    int16_t* current;
    if (s->period[j] == 0) continue;
    current = s->drive[s->period[j] - 1];
    event[s->period[j] - 1] = 1;
    synapses += (uint32_t)p->nonzero[j] * (uint32_t)(SPIKE_TICKS / s->period[j]);
    rows += p->nonzero[j];
    for (k = 0; k < outputs; ++k) current[k] = (int16_t)(current[k] + weight[k]);
  }
  /* From the last tick on, because the neurons of period n also fire at later multiples of n. */
  for (t = SPIKE_TICKS; t >= 1; --t) {
    for (n = 1; 2 * n <= t; ++n) {
      if (t % n != 0 || !event[n - 1]) continue;
      event[t - 1] = 1;
      for (k = 0; k < outputs; ++k) {
        s->drive[t - 1][k] = (int16_t)(s->drive[t - 1][k] + s->drive[n - 1][k]);
      }
    }
  }
#if SPIKE_PHASES
  for (j = 0; has_phase && j < SPIKE_HEADS; ++j, weight += outputs) {
    int fires = 0;
    for (t = 0; t < SPIKE_TICKS; ++t) {
      if (!phase_fires(j, timestep, t)) continue;
      fires = event[t] = 1;
      synapses += p->nonzero[SPIKE_HIDDEN + j];
      for (k = 0; k < outputs; ++k) s->drive[t][k] = (int16_t)(s->drive[t][k] + weight[k]);
    }
    if (fires) rows += p->nonzero[SPIKE_HIDDEN + j];
  }
#else
  (void)has_phase;
  (void)timestep;
#endif
  costs->accumulates += synapses;
  costs->weight_bytes += rows;
}

/* Fires a population that receives the coder's spikes. Sets `bits` to the spikes by head, or
   s->input to the spikes of each neuron if it is null. */
static void fire(spike_state* s, const spike_population* p, uint32_t timestep,
                 spike_word (*bits)[SPIKE_TICKS][SPIKE_WORDS], int stage, spike_costs* costs) {
  uint8_t event[SPIKE_TICKS];
  int k, t, events = 0, last = 0;
  drive(s, p, bits != NULL, timestep, event, costs);
  for (t = 0; t < SPIKE_TICKS; ++t) {
    if (!event[t]) continue;
    ++events;
    last = t + 1;
  }
  costs->membrane_updates += (uint32_t)(p->outputs * events);
  if (last > 0) {
    costs->membrane_leaks += (uint32_t)(p->outputs * (last - 1));
    costs->driven_neurons += (uint32_t)p->outputs;
  }
  if (bits != NULL) memset(bits, 0, sizeof(s->query));
  for (k = 0; k < p->outputs; ++k) {
    const int i = k % SPIKE_HEAD_SIZE;
    int32_t membrane = 0, count = 0;
    for (t = 0; t < last; ++t) {
      membrane = limit(membrane - SPIKE_LEAKED(membrane) + p->bias[k], -32768, 32767);
      if (!event[t]) continue;
      membrane = limit(membrane + s->drive[t][k], -32768, 32767);
      if (membrane < p->threshold[k]) continue;
      membrane = 0;
      ++count;
      if (bits != NULL) {
        spike_word* word = &bits[k / SPIKE_HEAD_SIZE][t][i / SPIKE_WORD_BITS];
        *word = (spike_word)(*word | (spike_word)1 << i % SPIKE_WORD_BITS);
      }
    }
    costs->spikes[stage] += (uint32_t)count;
    if (bits == NULL) s->input[k] = (int16_t)count;
  }
}
