
/* The session: what core/agent/agent_session.cc does, for one agent. */

typedef char spike_state_has_the_stated_size[sizeof(spike_state) == SPIKE_STATE_BYTES ? 1 : -1];
typedef char spike_shifts_are_arithmetic[(-1 >> 1) == -1 ? 1 : -1];
typedef char spike_floats_have_32_bits[sizeof(float) == 4 && sizeof(double) == 8 ? 1 : -1];

static void open_texts(spike_state* s);

static spike_timestep* timestep_at(const spike_state* s, uint32_t i) {
  return (spike_timestep*)&s->history[(s->oldest + i) % SPIKE_HISTORY];
}

static int is_action(const spike_action* action) {
#if SPIKE_DISCRETE
  return action->index >= 0 && action->index < SPIKE_ACTIONS;
#else
  int i;
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
    if (!(action->value[i] >= action_low[i] && action->value[i] <= action_high[i])) return 0;
  }
  return 1;
#endif
}

static int is_same(const spike_action* a, const spike_action* b) {
#if SPIKE_DISCRETE
  return a->index == b->index;
#else
  int i;
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
    if (a->value[i] != b->value[i]) return 0;
  }
  return 1;
#endif
}

static int is_float32_exact(void) {
  volatile float a = 1.000244140625f, b = 16777216.0f, one = 1.0f; /* 1 + 2^-12; 2^24 */
  const float c = a, big = b;
  const float product = c * c - 1.00048828125f; /* 2^-24 if it is fused, 0 if it is rounded */
  return product == 0.0f && (big + one) - big == 0.0f;
}

spike_error spike_init(spike_state* s) {
  memset(s, 0, sizeof(*s));
  return is_float32_exact() ? SPIKE_OK : SPIKE_ARITHMETIC;
}

spike_error spike_open(spike_state* s, double target_return, uint64_t seed, float temperature) {
  if (!is_float(target_return)) return SPIKE_NUMBER;
  if (!is_float(temperature) || temperature < 0.0f) return SPIKE_TEMPERATURE;
  if (!SPIKE_DISCRETE && temperature > 0.0f) return SPIKE_TEMPERATURE;
  memset(s, 0, sizeof(*s));
  s->session_target = s->target_return = s->return_to_go = target_return;
  s->seed = seed;
  s->temperature = temperature;
  s->is_open = 1;
  open_texts(s);
  return SPIKE_OK;
}

static double next_return(const spike_state* s, double reward) {
  return s->step == 0 ? s->target_return : s->return_to_go - reward;
}

/* Checks what a call says about the action before. */
static spike_error check(const spike_state* s, double reward, const spike_action* executed) {
  if (s->step == 0) return SPIKE_OK;
  if (!is_finite(reward) || !is_float(next_return(s, reward))) return SPIKE_NUMBER;
  return executed == NULL || is_action(executed) ? SPIKE_OK : SPIKE_NUMBER;
}

/* Brings the keys and values up to the last action, which they lack. */
static void fill(spike_state* s) {
  uint32_t i;
  if (s->step == 0) s->context_first = 0;
  if (s->step == 0) return;
  if (!s->context_held) {
    s->context_first = s->step - s->timesteps;
    for (i = 0; i < s->timesteps; ++i) {
      spike_costs ignored;
      memset(&ignored, 0, sizeof(ignored));
      run_return_and_state(s, s->context_first + i, timestep_at(s, i),
                           i == 0 ? NULL : timestep_at(s, i - 1)->observation, &ignored);
      if (i + 1 < s->timesteps) {
        run_action(s, s->context_first + i, &timestep_at(s, i)->action, &ignored);
      }
    }
  }
  s->context_held = 1;
  memset(&s->action_costs, 0, sizeof(s->action_costs));
  run_action(s, s->step - 1, &timestep_at(s, s->timesteps - 1)->action, &s->action_costs);
}

static uint32_t total_spikes(const spike_costs* costs) {
  uint32_t sum = 0;
  int i;
  for (i = 0; i < 8; ++i) sum += costs->spikes[i];
  return sum;
}

spike_error spike_decide(spike_state* s, const float* observation, double reward,
                         const spike_action* executed, spike_action* action) {
  float logits[SPIKE_ACTIONS];
  spike_costs costs;
  spike_timestep now;
  spike_action before;
  const float* previous = NULL;
  spike_error error;
  double energy;
  int i;
  if (!s->is_open) return SPIKE_ORDER;
  for (i = 0; i < SPIKE_OBSERVATIONS; ++i) {
    if (!is_finite(observation[i])) return SPIKE_NUMBER;
  }
  error = check(s, reward, executed);
  if (error != SPIKE_OK) return error;
  if (s->step == 0) reward = 0.0;

  memset(&now, 0, sizeof(now));
  now.return_to_go = (float)next_return(s, reward);
  memcpy(now.observation, observation, sizeof(now.observation));
  if (s->step > 0) {
    spike_timestep* last = timestep_at(s, s->timesteps - 1);
    before = last->action;
    if (executed != NULL && !is_same(executed, &before)) last->action = *executed;
    previous = last->observation;
  } else {
    memset(&before, 0, sizeof(before));
    memset(&s->action_costs, 0, sizeof(s->action_costs));
  }
  fill(s);
  costs = s->action_costs;
  run_return_and_state(s, s->step, &now, previous, &costs);
#if SPIKE_PHASES
  for (i = 0; i < SPIKE_HEADS; ++i) {
    int t;
    for (t = 0; t < SPIKE_TICKS; ++t)
      costs.spikes[SPIKE_PHASE] += (uint32_t)phase_fires(i, s->step, t);
  }
#endif
  code(s, &readout_coder, SPIKE_READOUT, &costs);
  run_head(s, logits, &costs);
  for (i = 0; i < SPIKE_ACTIONS; ++i) {
    if (is_finite(logits[i])) continue;
    s->context_held = 0; /* they hold a decision that was not made */
    if (s->step > 0) timestep_at(s, s->timesteps - 1)->action = before;
    return SPIKE_NUMBER;
  }
  choose(s, logits, &now.action);

  energy = default_energy(&costs);
  s->return_to_go = next_return(s, reward);
  s->episode_return += reward;
  s->episode_spikes += total_spikes(&costs);
  s->episode_energy += energy;
  s->spikes += total_spikes(&costs);
  s->energy += energy;
  s->context_held = 1;
  if (s->timesteps < SPIKE_HISTORY) {
    ++s->timesteps;
  } else {
    s->oldest = (s->oldest + 1) % SPIKE_HISTORY;
  }
  *timestep_at(s, s->timesteps - 1) = now;
  ++s->step;
  ++s->decisions;
  s->end_bytes = 0;
  s->last_costs = costs;
  s->last_return_to_go = now.return_to_go;
  memcpy(s->logits, logits, sizeof(s->logits));
  s->answered = now.action;
  *action = now.action;
  return SPIKE_OK;
}

spike_error spike_counts(const spike_state* s, spike_report* report) {
  if (!s->is_open || s->step == 0) return SPIKE_ORDER;
  memset(report, 0, sizeof(*report));
  report->last = s->last_costs;
  integer_energies(&s->last_costs, &report->int_45nm, &report->int_sram_45nm);
  report->return_to_go = s->last_return_to_go;
  memcpy(report->logits, s->logits, sizeof(s->logits));
  report->step = s->step;
  report->episode = s->episode;
  report->decisions = s->decisions;
  report->spikes = s->spikes;
  report->episode_return = s->episode_return;
#if SPIKE_DISCRETE
  softmax(s->logits, s->temperature > 0.0f ? s->temperature : 1.0f, report->probabilities);
#endif
  return SPIKE_OK;
}
