/* The network, as docs/design/integer.md defines it. Nothing here is a floating-point number. */

typedef struct {
  const int8_t* weight;    /* [inputs][outputs] */
  const uint16_t* nonzero; /* [inputs]: nonzero weights */
  const int8_t* shift;     /* [outputs] */
  const int16_t* bias;     /* [outputs] */
  uint16_t inputs, outputs;
} spike_map;

typedef struct {
  const int16_t *weight, *bias; /* [SPIKE_HIDDEN]; null: no norms */
  int8_t shift;
} spike_norm;

typedef struct {
  const int8_t* sign;       /* [SPIKE_HIDDEN] */
  const int16_t* threshold; /* [SPIKE_HIDDEN][SPIKE_TICKS] */
} spike_coder;

typedef struct {
  const int8_t* weight;    /* [inputs][outputs] */
  const uint16_t* nonzero; /* [inputs] */
  const int16_t *bias, *threshold;
  uint16_t outputs;
} spike_population;

typedef struct {
  spike_map map;
  spike_norm norm;
} spike_mapped;

typedef struct {
  spike_coder coder, ffn_coder;
  spike_population query, key, value, ffn_hidden;
  spike_mapped attention_output, ffn_output;
  const int16_t* scale; /* [SPIKE_HEADS] */
#if SPIKE_ROUTING
  spike_map routing_hidden, routing_gate;
#endif
} spike_layer;
