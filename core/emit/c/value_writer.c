
/* The value of a session: CBOR (RFC 8949) with a checksum, as core/journal writes it. */

typedef struct {
  uint8_t* to; /* null: only counts */
  size_t capacity, size;
} spike_writer;

static void put(spike_writer* w, uint8_t byte) {
  if (w->to != NULL && w->size < w->capacity) w->to[w->size] = byte;
  ++w->size;
}

static void put_big_endian(spike_writer* w, int first, uint64_t value, int bytes) {
  put(w, (uint8_t)first);
  while (bytes-- > 0) put(w, (uint8_t)(value >> (8 * bytes)));
}

/* Writes the major type and its argument in the shortest form. */
static void put_head(spike_writer* w, int major, uint64_t argument) {
  const int first = major << 5;
  if (argument < 24) {
    put(w, (uint8_t)(first + (int)argument));
  } else if (argument <= 0xff) {
    put_big_endian(w, first + 24, argument, 1);
  } else if (argument <= 0xffff) {
    put_big_endian(w, first + 25, argument, 2);
  } else if (argument <= 0xffffffffu) {
    put_big_endian(w, first + 26, argument, 4);
  } else {
    put_big_endian(w, first + 27, argument, 8);
  }
}

static void put_unsigned(spike_writer* w, uint64_t value) { put_head(w, 0, value); }
static void put_array(spike_writer* w, uint32_t items) { put_head(w, 4, items); }
static void put_null(spike_writer* w) { put(w, 0xf6); }
static void put_bool(spike_writer* w, int value) { put(w, value ? 0xf5 : 0xf4); }

static void put_text(spike_writer* w, const char* text) {
  put_head(w, 3, strlen(text));
  while (*text != 0) put(w, (uint8_t)*text++);
}

static void put_bytes(spike_writer* w, const uint8_t* bytes, uint32_t size) {
  uint32_t i;
  for (i = 0; i < size; ++i) put(w, bytes[i]);
}

static void put_float(spike_writer* w, float value) {
  uint32_t bits;
  memcpy(&bits, &value, 4);
  put_big_endian(w, 0xfa, bits, 4);
}

static void put_double(spike_writer* w, double value) {
  uint64_t bits;
  memcpy(&bits, &value, 8);
  put_big_endian(w, 0xfb, bits, 8);
}

static void put_floats(spike_writer* w, const float* values, uint32_t size) {
  uint32_t i;
  put_array(w, size);
  for (i = 0; i < size; ++i) put_float(w, values[i]);
}

static void put_action(spike_writer* w, const spike_action* action) {
  put_array(w, 2);
#if SPIKE_DISCRETE
  put_unsigned(w, (uint64_t)action->index);
  put_array(w, 0);
#else
  put_unsigned(w, 0);
  put_floats(w, action->value, SPIKE_ACTIONS);
#endif
}

static void put_answer(spike_writer* w, const spike_state* s) {
  const uint32_t* count = (const uint32_t*)&s->last_costs;
  uint32_t i;
  put_array(w, 8);
  put_unsigned(w, s->step - 1);
  put_action(w, &s->answered);
#if SPIKE_DISCRETE
  {
    float probabilities[SPIKE_ACTIONS];
    softmax(s->logits, s->temperature > 0.0f ? s->temperature : 1.0f, probabilities);
    put_floats(w, probabilities, SPIKE_ACTIONS);
  }
#else
  put_array(w, 0);
#endif
  put_float(w, s->last_return_to_go);
  put_array(w, 1 + 15);
  put_array(w, 8);
  for (i = 0; i < 8; ++i) put_unsigned(w, count[i]);
  for (i = 8; i < 8 + 15; ++i) put_unsigned(w, count[i]);
  put_unsigned(w, 0); /* unusual observations, which a server counts */
  put_double(w, 0.0); /* seconds */
  put_floats(w, s->logits, SPIKE_ACTIONS);
}

static void put_session(spike_writer* w, const spike_state* s) {
  uint32_t i;
  put_array(w, 2);
  put_text(w, "spikeserve.session.v1");
  put_array(w, 17);
  put_bytes(w, s->text, s->head_bytes);
  put_floats(w, s->head_delta, s->has_delta ? SPIKE_ACTIONS * SPIKE_HIDDEN : 0);
  put_bytes(w, s->text + s->head_bytes, s->text_bytes - s->head_bytes);
  put_unsigned(w, s->episode);
  put_unsigned(w, s->step);
  put_double(w, s->target_return);
  put_double(w, s->return_to_go);
  put_double(w, s->episode_return);
  put_unsigned(w, s->episode_spikes);
  put_double(w, s->episode_energy);
  put_array(w, s->timesteps);
  for (i = 0; i < s->timesteps; ++i) {
    const spike_timestep* t = timestep_at(s, i);
    put_array(w, 3);
    put_float(w, t->return_to_go);
    put_floats(w, t->observation, SPIKE_OBSERVATIONS);
    put_action(w, &t->action);
  }
  if (s->step > 0) {
    put_answer(w, s);
  } else {
    put_null(w);
  }
  if (s->end_bytes > 0) {
    put_bytes(w, s->end_text, s->end_bytes);
  } else {
    put_null(w);
  }
  put_unsigned(w, s->decisions);
  put_unsigned(w, s->spikes);
  put_double(w, s->energy);
  put_null(w); /* no learner */
  put_null(w); /* and nothing that it has learned */
}

/* FNV-1a. */
static uint64_t checksum(const uint8_t* bytes, size_t size) {
  uint64_t hash = 0xcbf29ce484222325u;
  while (size-- > 0) hash = (hash ^ *bytes++) * 0x100000001b3u;
  return hash;
}

spike_error spike_export(const spike_state* s, uint8_t* value, size_t capacity, size_t* size) {
  spike_writer w = {NULL, 0, 0};
  uint64_t hash;
  int i;
  if (!s->is_open) return SPIKE_ORDER;
  w.to = value;
  w.capacity = capacity;
  put_session(&w, s);
  *size = w.size + 8;
  if (value == NULL) return SPIKE_OK;
  if (*size > capacity) return SPIKE_SPACE;
  hash = checksum(value, w.size);
  for (i = 0; i < 8; ++i) value[w.size + (size_t)i] = (uint8_t)(hash >> (8 * i));
  return SPIKE_OK;
}

/* The first texts of a session that was opened here: its id, and its options up to the head. */
static void open_texts(spike_state* s) {
  spike_writer w = {NULL, SPIKE_TEXT_BYTES, 0};
  w.to = s->text;
  put_text(&w, "chip");
  put_array(&w, 12);
  put_text(&w, SPIKE_POLICY);
  put_unsigned(&w, SPIKE_VERSION);
  put_double(&w, s->session_target);
  put_unsigned(&w, s->seed);
  put_array(&w, 2);
  put_bool(&w, s->temperature > 0.0f);
  put_float(&w, s->temperature > 0.0f ? s->temperature : 1.0f);
  put_head(&w, 5, 0);
  put_text(&w, "");
  put_null(&w);
  s->head_bytes = (uint32_t)w.size;
  put_text(&w, "none");
  put_text(&w, "");
  put_text(&w, SPIKE_SHA256);
  s->text_bytes = (uint32_t)w.size;
}

spike_error spike_end_episode(spike_state* s, double reward, int terminated,
                              const spike_action* executed, const double* target_return) {
  spike_writer w = {NULL, SPIKE_END_BYTES, 0};
  const double target = target_return == NULL ? s->session_target : *target_return;
  spike_error error;
  if (!s->is_open || s->step == 0) return SPIKE_ORDER;
  error = check(s, reward, executed);
  if (error != SPIKE_OK) return error;
  if (!is_float(target)) return SPIKE_NUMBER;
  w.to = s->end_text;
  put_array(&w, 2);
  put_array(&w, 6);
  put_double(&w, reward);
  put_bool(&w, terminated);
  if (target_return == NULL) {
    put_null(&w);
  } else {
    put_double(&w, target);
  }
  put_bool(&w, 0); /* truncated, and the last observation: only recordings have these */
  put_array(&w, 0);
  put_action(&w, executed == NULL ? &timestep_at(s, s->timesteps - 1)->action : executed);
  put_array(&w, 5);
  put_double(&w, s->episode_return + reward);
  put_unsigned(&w, s->step);
  put_unsigned(&w, s->episode_spikes);
  put_double(&w, s->episode_energy);
  put_null(&w);
  s->end_bytes = (uint32_t)w.size;
  ++s->episode;
  s->step = s->timesteps = s->oldest = s->context_held = 0;
  s->target_return = s->return_to_go = target;
  s->episode_return = s->episode_energy = 0.0;
  s->episode_spikes = 0;
  return SPIKE_OK;
}
