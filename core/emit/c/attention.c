
/* A token: the timestep, and its place in it (0 return, 1 state, 2 action). */
typedef struct {
  uint32_t timestep;
  int kind;
} spike_token;

static int slot_of(spike_token token) {
  return (int)(token.timestep % SPIKE_CONTEXT) * 3 + token.kind;
}

/* Returns the first timestep of the band of `token`. */
static uint32_t band_of(const spike_state* s, spike_token token) {
  const uint32_t first =
      token.timestep + 1 > SPIKE_CONTEXT ? token.timestep + 1 - SPIKE_CONTEXT : 0;
  return first > s->context_first ? first : s->context_first;
}

/* Moves to the next token of the band. Returns 0 behind `last`. */
static int next_token(spike_token* token, spike_token last) {
  if (token->timestep == last.timestep && token->kind == last.kind) return 0;
  token->kind = token->kind == 2 ? 0 : token->kind + 1;
  token->timestep += token->kind == 0;
  return 1;
}

/* Ticks that attention takes together: those from `first` on that are not active, or an active one
   alone. Without SPIKE_BY_TICK none is active, and the only group are all ticks. */
typedef struct {
  const uint8_t* active; /* whether the query fires, [SPIKE_TICKS] */
  int first, ticks;
} spike_group;

static int in_group(const spike_group* group, int t) {
  return t == group->first || (!group->active[t] && !group->active[group->first]);
}

/* Returns the values of a head of a token that are not 0: spikes, or neurons that fire. */
static uint32_t nonzero_values(spike_word (*spikes)[SPIKE_WORDS], const spike_group* group) {
  uint32_t count = 0;
  int t, w;
  for (w = 0; w < SPIKE_WORDS; ++w) {
    spike_word any = 0;
    for (t = 0; t < SPIKE_TICKS; ++t) {
      if (!in_group(group, t)) continue;
      if (SPIKE_BY_TICK) count += ones(spikes[t][w]);
      any = (spike_word)(any | spikes[t][w]);
    }
    if (!SPIKE_BY_TICK) count += ones(any);
  }
  return count;
}

/* Adds `weight` times the spikes of a head to the sums [SPIKE_HEAD_SIZE]. */
static void add_values(int32_t* sums, spike_word (*spikes)[SPIKE_WORDS], const spike_group* group,
                       int32_t weight) {
  int t, w, k;
  for (t = group->first; t < SPIKE_TICKS; ++t) {
    if (!in_group(group, t)) continue;
    for (w = 0; w < SPIKE_WORDS; ++w) {
      spike_word bits = spikes[t][w];
      for (k = w * SPIKE_WORD_BITS; bits != 0; bits = (spike_word)(bits >> 1), ++k) {
        if (bits & 1) sums[k] += weight;
      }
    }
  }
}

/* Returns the sums of values that are not 0 of all ticks of a group but its first one. */
static uint32_t nonzero_sums(const spike_state* s, int layer, int head, spike_token last,
                             const spike_group* group) {
  uint32_t count = 0;
  int t, w;
  for (t = group->first + 1; SPIKE_BY_TICK && t < SPIKE_TICKS; ++t) {
    if (!in_group(group, t)) continue;
    for (w = 0; w < SPIKE_WORDS; ++w) {
      spike_token token = {0, 0};
      spike_word any = 0;
      token.timestep = band_of(s, last);
      do {
        any = (spike_word)(any | s->values[layer][slot_of(token)][head][t][w]);
      } while (next_token(&token, last));
      count += ones(any);
    }
  }
  return count;
}

/* Sets s->weights to the weights of the keys of a row, in the order of the band. Returns their
   sum; 0: no query neuron fires, so that all weigh the same. */
static int32_t weigh_keys(spike_state* s, int layer, int head, spike_token last,
                          const spike_group* group, spike_costs* costs) {
  const int spike_bytes = (group->ticks * SPIKE_HEAD_SIZE + 7) / 8;
  spike_token token = {0, 0};
  int32_t best = INT32_MIN, sum = 0;
  uint32_t overlaps = 0;
  int n = 0, i, t, w;
  if (nonzero_values(s->query[head], group) == 0) {
    costs->attention_bytes += (uint32_t)2 * SPIKE_HEAD_SIZE * (SPIKE_BY_TICK ? group->ticks : 1);
    costs->attention_products += nonzero_sums(s, layer, head, last, group);
    return 0;
  }
  token.timestep = band_of(s, last);
  do {
    spike_word(*key)[SPIKE_WORDS] = s->keys[layer][slot_of(token)][head];
    uint32_t overlap = 0;
    for (t = group->first; t < SPIKE_TICKS; ++t) {
      if (!in_group(group, t)) continue;
      for (w = 0; w < SPIKE_WORDS; ++w) overlap += ones(s->query[head][t][w] & key[t][w]);
    }
    overlaps += overlap;
    s->weights[n++] = (int32_t)overlap;
  } while (next_token(&token, last));
  costs->softmax_terms += (uint32_t)n;
  costs->attention_bytes +=
      (uint32_t)(n * (spike_bytes + (SPIKE_BY_TICK ? spike_bytes : SPIKE_HEAD_SIZE)));
  costs->attention_products += overlaps;
  for (i = 0; i < n; ++i) {
    s->weights[i] *= layers[layer].scale[head];
    if (s->weights[i] > best) best = s->weights[i];
  }
  for (i = 0; i < n; ++i) {
    const int32_t octaves = round_shift(best - s->weights[i], 8);
    sum += s->weights[i] = octaves > 8 ? 0 : 256 >> octaves;
  }
  return sum;
}

/* Sets s->sums to the attention of a token for a group of ticks, [SPIKE_HEADS][SPIKE_HEAD_SIZE],
   with 8 fraction bits. */
static void attend(spike_state* s, int layer, spike_token last, const spike_group* group,
                   spike_costs* costs) {
  int head, k;
  for (head = 0; head < SPIKE_HEADS; ++head) {
    int32_t* y = s->sums + head * SPIKE_HEAD_SIZE;
    int32_t sum = weigh_keys(s, layer, head, last, group, costs);
    const int is_mean = sum == 0;
    spike_token token = {0, 0};
    int n = 0;
    token.timestep = band_of(s, last);
    for (k = 0; k < SPIKE_HEAD_SIZE; ++k) y[k] = 0;
    do {
      spike_word(*value)[SPIKE_WORDS] = s->values[layer][slot_of(token)][head];
      const int32_t weight = is_mean ? 1 : s->weights[n];
      ++n;
      if (weight == 0) continue;
      if (!is_mean) costs->attention_products += nonzero_values(value, group);
      add_values(y, value, group, weight);
    } while (next_token(&token, last));
    if (is_mean) sum = n;
    for (k = 0; k < SPIKE_HEAD_SIZE; ++k) {
      if (y[k] == 0) continue;
      ++costs->attention_scalings;
      y[k] = limit(round_divide(256 * y[k], sum * group->ticks), 0, 255);
    }
  }
}

/* Counts what a token leaves behind: its key, its value, and its part of the sum of all values. */
static void count_stored(spike_state* s, int layer, int slot, spike_costs* costs) {
  const uint8_t active[SPIKE_TICKS] = {0};
  const uint32_t spike_bytes = (SPIKE_TICKS * SPIKE_HIDDEN + 7) / 8;
  spike_group all = {NULL, 0, SPIKE_TICKS};
  uint32_t sums = 0;
  int head;
  all.active = active;
  for (head = 0; head < SPIKE_HEADS; ++head)
    sums += 2 * nonzero_values(s->values[layer][slot][head], &all);
  costs->attention_products += sums;
  costs->attention_bytes += spike_bytes + (SPIKE_BY_TICK ? spike_bytes : SPIKE_HIDDEN) + 4 * sums;
}

#if SPIKE_ROUTING
/* Sets s->gates from the attention in s->input, with 8 fraction bits. */
static void route(spike_state* s, const spike_layer* layer, spike_costs* costs) {
  int32_t best = INT32_MIN, sum = 0;
  uint32_t products;
  int h, k;
  count_map(costs, apply_map(s, &layer->routing_hidden));
  for (k = 0; k < layer->routing_hidden.outputs; ++k)
    s->input[k] = (int16_t)limit(s->sums[k], 0, 32767);
  products = apply_map(s, &layer->routing_gate);
  count_map(costs, products);
  costs->wide_multiply_accumulates += products;
  costs->gate_products += SPIKE_HIDDEN;
  for (h = 0; h < SPIKE_HEADS; ++h) {
    s->gates[h] = s->sums[h];
    if (s->gates[h] > best) best = s->gates[h];
  }
  if (SPIKE_SIGMOID) {
    for (h = 0; h < SPIKE_HEADS; ++h) {
      const int32_t gate = s->gates[h], other = power_of_two((uint32_t)(gate < 0 ? -gate : gate));
      s->gates[h] = round_divide((gate >= 0 ? 65536 : other) * 256, 65536 + other);
    }
    return;
  }
  costs->softmax_terms += SPIKE_HEADS;
  for (h = 0; h < SPIKE_HEADS; ++h)
    sum += s->gates[h] = power_of_two((uint32_t)best - (uint32_t)s->gates[h]);
  for (h = 0; h < SPIKE_HEADS; ++h) s->gates[h] = round_divide(s->gates[h] * 256, sum);
}
#endif

/* Adds the heads in s->sums, times their gates and the ticks of their group, to s->merged. */
static void add_heads(spike_state* s, const spike_layer* layer, int ticks, spike_costs* costs) {
  int k;
#if SPIKE_ROUTING
  int16_t* const y = s->drive[0]; /* which no population needs now */
  for (k = 0; k < SPIKE_HIDDEN; ++k) y[k] = s->input[k] = (int16_t)s->sums[k];
  route(s, layer, costs);
  for (k = 0; k < SPIKE_HIDDEN; ++k) s->sums[k] = s->gates[k / SPIKE_HEAD_SIZE] * y[k];
#else
  (void)layer;
  (void)costs;
#endif
  for (k = 0; k < SPIKE_HIDDEN; ++k) s->merged[k % SPIKE_MERGED] += ticks * s->sums[k];
}

/* Sets s->input to the merged attention of a token. */
static void attend_and_merge(spike_state* s, int layer, spike_token last, spike_costs* costs) {
  const int32_t unit = SPIKE_ROUTING ? 256 : SPIKE_CONCAT ? 1 : SPIKE_HEADS;
  uint8_t active[SPIKE_TICKS];
  spike_group group = {NULL, 0, 0};
  int h, k, t, w, silent = SPIKE_TICKS, first_silent = -1;
  for (t = SPIKE_TICKS - 1; t >= 0; --t) {
    spike_word any = 0;
    for (h = 0; SPIKE_BY_TICK && h < SPIKE_HEADS; ++h) {
      for (w = 0; w < SPIKE_WORDS; ++w) any = (spike_word)(any | s->query[h][t][w]);
    }
    active[t] = any != 0;
    silent -= active[t];
    if (!active[t]) first_silent = t;
  }
  group.active = active;
  memset(s->merged, 0, sizeof(s->merged));
  for (t = 0; t < SPIKE_TICKS; ++t) {
    if (!active[t] && t != first_silent) continue;
    group.first = t;
    group.ticks = active[t] ? 1 : silent;
    attend(s, layer, last, &group, costs);
    add_heads(s, &layers[layer], group.ticks, costs);
  }
  for (k = 0; k < SPIKE_MERGED; ++k) {
    const int32_t sum = s->merged[k] * SPIKE_GATE_FACTOR;
    s->input[k] = (int16_t)limit(round_divide(sum, unit * SPIKE_TICKS), 0, 255);
  }
}

/* Computes a token from s->input, and adds its cost. */
static void run_token(spike_state* s, spike_token token, const spike_mapped* embedding,
                      spike_costs* costs) {
  const int is_state = token.kind == 1;
  const int slot = slot_of(token);
  int layer;
  memset(s->x, 0, sizeof(s->x));
  costs->wide_multiply_accumulates += add_map(s, embedding, costs);
  costs->weight_bytes += (uint32_t)embedding->map.inputs * SPIKE_HIDDEN;
  for (layer = 0; layer < SPIKE_LAYERS; ++layer) {
    const spike_layer* w = &layers[layer];
    code(s, &w->coder, SPIKE_CODER, costs);
    fire(s, &w->key, token.timestep, s->keys[layer][slot], SPIKE_KEY, costs);
    fire(s, &w->value, token.timestep, s->values[layer][slot], SPIKE_VALUE, costs);
    count_stored(s, layer, slot, costs);
    if (layer + 1 == SPIKE_LAYERS && !is_state) return;
    fire(s, &w->query, token.timestep, s->query, SPIKE_QUERY, costs);
    attend_and_merge(s, layer, token, costs);
    add_map(s, &w->attention_output, costs);
    code(s, &w->ffn_coder, SPIKE_FFN_IN, costs);
    fire(s, &w->ffn_hidden, token.timestep, NULL, SPIKE_FFN_HIDDEN, costs);
    costs->weight_bytes += add_map(s, &w->ffn_output, costs);
    if (!is_state) continue;
    costs->weight_bytes += SPIKE_HIDDEN * SPIKE_MERGED +
                           SPIKE_ROUTING * SPIKE_ROUTING_HIDDEN * (SPIKE_HIDDEN + SPIKE_HEADS);
  }
}
