
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
  uint32_t end_bytes = 0, items;
  uint64_t numbers[3], step, episode;
  double reals[5];
  take_array(r, 2, 2);
  if (!take_text(r, "spikeserve.session.v1")) fail(r, SPIKE_DAMAGED);
  items = take_array(r, 17, 17 + 15);
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
  while (items-- > 17) skip(r); /* what servers keep beside the session, for no decision */
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
