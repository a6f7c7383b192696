
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

/* Reads a value. The first thing that is not as expected sets `error`, and the rest reads zeros. */
typedef struct {
  const uint8_t *at, *end;
  spike_error error;
} spike_reader;

static void fail(spike_reader* r, spike_error error) {
  if (r->error == SPIKE_OK) r->error = error;
  r->at = r->end;
}

static uint64_t take_big_endian(spike_reader* r, int bytes) {
  uint64_t value = 0;
  if (r->end - r->at < bytes) {
    fail(r, SPIKE_DAMAGED);
    return 0;
  }
  while (bytes-- > 0) value = value << 8 | *r->at++;
  return value;
}

/* Returns the argument of an item of this major type. */
static uint64_t take_head(spike_reader* r, int major) {
  const int first = (int)take_big_endian(r, 1);
  if (r->error != SPIKE_OK) return 0;
  if (first >> 5 != major || (first & 31) > 27) {
    fail(r, SPIKE_DAMAGED);
    return 0;
  }
  return (first & 31) < 24 ? (uint64_t)(first & 31) : take_big_endian(r, 1 << ((first & 31) - 24));
}

static uint64_t take_unsigned(spike_reader* r, uint64_t most) {
  const uint64_t value = take_head(r, 0);
  if (value > most) fail(r, SPIKE_DAMAGED);
  return r->error == SPIKE_OK ? value : 0;
}

static uint32_t take_array(spike_reader* r, uint32_t least, uint32_t most) {
  const uint64_t items = take_head(r, 4);
  if (items < least || items > most) fail(r, SPIKE_DAMAGED);
  return r->error == SPIKE_OK ? (uint32_t)items : 0;
}

/* Returns whether the next byte is `byte`, and takes it if so. */
static int take_if(spike_reader* r, int byte) {
  if (r->at == r->end || *r->at != byte) return 0;
  ++r->at;
  return 1;
}

static int take_bool(spike_reader* r) {
  if (take_if(r, 0xf5)) return 1;
  if (!take_if(r, 0xf4)) fail(r, SPIKE_DAMAGED);
  return 0;
}

static double take_double(spike_reader* r) {
  double value = 0.0;
  uint64_t bits;
  if (!take_if(r, 0xfb)) fail(r, SPIKE_DAMAGED);
  bits = take_big_endian(r, 8);
  memcpy(&value, &bits, 8);
  if (is_finite(value)) return value;
  fail(r, SPIKE_DAMAGED);
  return 0.0;
}

static float take_float(spike_reader* r) {
  float value = 0.0f;
  uint32_t bits;
  if (!take_if(r, 0xfa)) fail(r, SPIKE_DAMAGED);
  bits = (uint32_t)take_big_endian(r, 4);
  memcpy(&value, &bits, 4);
  if (is_finite(value)) return value;
  fail(r, SPIKE_DAMAGED);
  return 0.0f;
}

/* Takes `size` numbers into `values`; null: nowhere. */
static void take_floats(spike_reader* r, float* values, uint32_t size) {
  uint32_t i;
  take_array(r, size, size);
  for (i = 0; i < size; ++i) {
    const float value = take_float(r);
    if (values != NULL) values[i] = value;
  }
}

/* Skips an item with all that it contains. */
static void skip(spike_reader* r) {
  uint64_t items = 1;
  while (items > 0 && r->error == SPIKE_OK) {
    const int first = r->at == r->end ? 0xff : *r->at;
    const int major = first >> 5;
    const size_t left = (size_t)(r->end - r->at);
    --items;
    if (first >= 0xf4 && first <= 0xf6) {
      ++r->at;
    } else if (first == 0xfa || first == 0xfb) {
      ++r->at;
      take_big_endian(r, first == 0xfa ? 4 : 8);
    } else if (major <= 5 && major != 2) {
      const uint64_t argument = take_head(r, major);
      if (major >= 3 && argument > left) {
        fail(r, SPIKE_DAMAGED);
      } else if (major == 3) {
        if (argument > (size_t)(r->end - r->at)) fail(r, SPIKE_DAMAGED);
        if (r->error == SPIKE_OK) r->at += argument;
      } else if (major > 3) {
        items += major == 4 ? argument : 2 * argument;
      }
    } else {
      fail(r, SPIKE_DAMAGED);
    }
  }
}

/* Skips a text, and returns whether it is `text`. */
static int take_text(spike_reader* r, const char* text) {
  const uint64_t size = take_head(r, 3);
  int is_same_text;
  if (r->error != SPIKE_OK || size > (size_t)(r->end - r->at)) {
    fail(r, SPIKE_DAMAGED);
    return 0;
  }
  is_same_text = size == strlen(text) && memcmp(r->at, text, (size_t)size) == 0;
  r->at += size;
  return is_same_text;
}

static void take_action(spike_reader* r, spike_action* action) {
  spike_action taken;
  take_array(r, 2, 2);
#if SPIKE_DISCRETE
  taken.index = (int32_t)take_unsigned(r, SPIKE_ACTIONS - 1);
  take_array(r, 0, 0);
#else
  take_unsigned(r, 0x7fffffff);
  take_floats(r, taken.value, SPIKE_ACTIONS);
  if (r->error == SPIKE_OK && !is_action(&taken)) fail(r, SPIKE_DAMAGED);
#endif
  if (action != NULL && r->error == SPIKE_OK) *action = taken;
}

/* Appends the bytes from `from` to here to the `used` bytes of a text; null: nowhere. Returns the
   bytes that are then used. */
static uint32_t keep(spike_reader* r, const uint8_t* from, uint8_t* text, uint32_t used,
                     uint32_t capacity) {
  const size_t size = r->error == SPIKE_OK ? (size_t)(r->at - from) : 0;
  if (size > capacity - used) {
    fail(r, SPIKE_LARGE);
    return used;
  }
  if (text != NULL) memcpy(text + used, from, size);
  return used + (uint32_t)size;
}

/* Reads the options. `s` may be null, here and below: then nothing is stored. */
static void take_options(spike_reader* r, spike_state* s) {
  const uint8_t* from = r->at;
  uint8_t* const text = s == NULL ? NULL : s->text;
  uint32_t head_bytes, text_bytes;
  double target;
  uint64_t seed;
  float temperature;
  int is_sampled;
  skip(r); /* the id */
  take_array(r, 12, 12);
  skip(r);
  skip(r); /* the policy and its version: the digest below identifies it */
  target = take_double(r);
  seed = take_unsigned(r, UINT64_MAX);
  take_array(r, 2, 2);
  is_sampled = take_bool(r);
  temperature = take_float(r);
  if (r->error == SPIKE_OK && !(temperature > 0.0f)) fail(r, SPIKE_DAMAGED);
  if (is_sampled && !SPIKE_DISCRETE) fail(r, SPIKE_TEMPERATURE);
  skip(r); /* the labels */
  skip(r); /* the tenant */
  if (r->error == SPIKE_OK && !take_if(r, 0xf6)) fail(r, SPIKE_LEARNS);
  head_bytes = keep(r, from, text, 0, SPIKE_TEXT_BYTES);
  if (take_if(r, 0x80)) {
    if (s != NULL) s->has_delta = 0;
  } else {
    take_floats(r, s == NULL ? NULL : s->head_delta, SPIKE_ACTIONS * SPIKE_HIDDEN);
    if (s != NULL) s->has_delta = 1;
  }
  from = r->at;
  skip(r); /* the durability */
  skip(r); /* the recording */
  if (!take_if(r, 0x60) && !take_text(r, SPIKE_SHA256)) fail(r, SPIKE_OTHER);
  text_bytes = keep(r, from, text, head_bytes, SPIKE_TEXT_BYTES);
  if (s == NULL || r->error != SPIKE_OK) return;
  s->head_bytes = head_bytes;
  s->text_bytes = text_bytes;
  s->session_target = target;
  s->seed = seed;
  s->temperature = is_sampled ? temperature : 0.0f;
}

static void take_answer(spike_reader* r, uint32_t step, spike_state* s) {
  uint32_t* count = s == NULL ? NULL : (uint32_t*)&s->last_costs;
  uint32_t i;
  take_array(r, 8, 8);
  if (take_unsigned(r, UINT32_MAX) != step - 1) fail(r, SPIKE_DAMAGED);
  take_action(r, s == NULL ? NULL : &s->answered);
  take_floats(r, NULL, SPIKE_DISCRETE ? SPIKE_ACTIONS : 0);
  if (s != NULL) {
    s->last_return_to_go = take_float(r);
  } else {
    take_float(r);
  }
  take_array(r, 16, 16);
  take_array(r, 8, 8);
  for (i = 0; i < 8 + 15; ++i) {
    const uint32_t value = (uint32_t)take_unsigned(r, UINT32_MAX);
    if (s != NULL) count[i] = value;
  }
  take_unsigned(r, UINT32_MAX);
  take_double(r);
  take_floats(r, s == NULL ? NULL : s->logits, SPIKE_ACTIONS);
}

static void take_history(spike_reader* r, uint32_t step, spike_state* s) {
  const uint32_t size = take_array(r, step > 0, step < SPIKE_HISTORY ? step : SPIKE_HISTORY);
  uint32_t i;
  if (s != NULL) {
    s->timesteps = size;
    s->oldest = 0;
  }
  for (i = 0; i < size && r->error == SPIKE_OK; ++i) {
    spike_timestep* to = s == NULL ? NULL : &s->history[i];
    const float return_to_go = (take_array(r, 3, 3), take_float(r));
    take_floats(r, to == NULL ? NULL : to->observation, SPIKE_OBSERVATIONS);
    take_action(r, to == NULL ? NULL : &to->action);
    if (to != NULL) to->return_to_go = return_to_go;
  }
}

static void take_session(spike_reader* r, spike_state* s) {
  const uint8_t* from;
  uint32_t end_bytes = 0;
  uint64_t numbers[3], step, episode;
  double reals[5];
  take_array(r, 2, 2);
  if (!take_text(r, "spikeserve.session.v1")) fail(r, SPIKE_DAMAGED);
  take_array(r, 17, 17);
  take_options(r, s);
  episode = take_unsigned(r, INT32_MAX);
  step = take_unsigned(r, INT32_MAX);
  reals[0] = take_double(r);
  reals[1] = take_double(r);
  reals[2] = take_double(r);
  numbers[0] = take_unsigned(r, UINT64_MAX);
  reals[3] = take_double(r);
  if (!is_float(reals[0]) || !is_float(reals[1])) fail(r, SPIKE_DAMAGED);
  take_history(r, (uint32_t)step, s);
  if (step > 0) {
    take_answer(r, (uint32_t)step, s);
  } else if (!take_if(r, 0xf6)) {
    fail(r, SPIKE_DAMAGED);
  }
  from = r->at;
  if (episode > 0 && step == 0) {
    if (r->at < r->end && *r->at == 0xf6) fail(r, SPIKE_DAMAGED);
    skip(r);
    end_bytes = keep(r, from, s == NULL ? NULL : s->end_text, 0, SPIKE_END_BYTES);
  } else {
    if (!take_if(r, 0xf6)) fail(r, SPIKE_DAMAGED);
  }
  numbers[1] = take_unsigned(r, UINT64_MAX);
  numbers[2] = take_unsigned(r, UINT64_MAX);
  reals[4] = take_double(r);
  if (r->error == SPIKE_OK && !take_if(r, 0xf6)) fail(r, SPIKE_LEARNS);
  if (r->error == SPIKE_OK && !take_if(r, 0xf6)) fail(r, SPIKE_LEARNS);
  if (r->error == SPIKE_OK && r->at != r->end) fail(r, SPIKE_DAMAGED);
  if (s == NULL || r->error != SPIKE_OK) return;
  s->episode = (uint32_t)episode;
  s->step = (uint32_t)step;
  s->target_return = reals[0];
  s->return_to_go = reals[1];
  s->episode_return = reals[2];
  s->episode_spikes = numbers[0];
  s->episode_energy = reals[3];
  s->decisions = numbers[1];
  s->spikes = numbers[2];
  s->energy = reals[4];
  s->end_bytes = end_bytes;
  s->context_held = 0;
  s->is_open = 1;
}

spike_error spike_import(spike_state* s, const uint8_t* value, size_t size) {
  spike_reader r = {NULL, NULL, SPIKE_OK};
  uint64_t expected = 0;
  int i;
  if (size < 8) return SPIKE_DAMAGED;
  for (i = 0; i < 8; ++i) expected |= (uint64_t)value[size - 8 + (size_t)i] << (8 * i);
  if (expected != checksum(value, size - 8)) return SPIKE_DAMAGED;
  /* First without a state, so that a value that is refused changes nothing. */
  r.at = value;
  r.end = value + size - 8;
  take_session(&r, NULL);
  if (r.error != SPIKE_OK) return r.error;
  r.at = value;
  take_session(&r, s);
  return SPIKE_OK;
}
