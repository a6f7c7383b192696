
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* What a call returns. A call that fails changes nothing. */
typedef enum {
  SPIKE_OK = 0,
  SPIKE_ORDER,  /* not now: no session is open, or the episode has no decision yet */
  SPIKE_NUMBER, /* an observation, reward or return is not finite, or an action is out of bounds */
  SPIKE_TEMPERATURE, /* not finite, negative, or for sampled actions of a Box, which need a server
                      */
  SPIKE_ARITHMETIC,  /* the compiler fuses or rounds float32 in another way; see spike_init */
  SPIKE_SPACE,       /* the buffer is too small; its size was set to what is needed */
  SPIKE_DAMAGED,     /* not the value of a session, or damaged since */
  SPIKE_OTHER,       /* the session belongs to another policy, of which the digest differs */
  SPIKE_LEARNS,      /* the session learns, which needs a server */
  SPIKE_LARGE        /* the session's labels or ids do not fit SPIKE_TEXT_BYTES */
} spike_error;

typedef struct {
#if SPIKE_DISCRETE
  int32_t index; /* 0 to SPIKE_ACTIONS - 1 */
#else
  float value[SPIKE_ACTIONS]; /* in the units of the environment */
#endif
} spike_action;

/* What decisions cost, as the server counts it (docs/design/integer.md). */
enum {
  SPIKE_CODER,
  SPIKE_PHASE,
  SPIKE_QUERY,
  SPIKE_KEY,
  SPIKE_VALUE,
  SPIKE_FFN_IN,
  SPIKE_FFN_HIDDEN,
  SPIKE_READOUT
};
typedef struct {
  uint32_t spikes[8];
  uint32_t accumulates, multiply_accumulates, attention_products, integer_multiply_accumulates;
  uint32_t membrane_updates, coder_gains, layer_norm_elements, softmax_terms, gate_products;
  uint32_t driven_neurons, membrane_leaks, wide_multiply_accumulates, attention_scalings;
  uint32_t weight_bytes, attention_bytes;
} spike_costs;

/* What spike_counts reports. Energies are estimates of 45 nm circuits, not of this processor. */
typedef struct {
  spike_costs last;               /* of the last decision */
  double int_45nm, int_sram_45nm; /* of the last decision, in joules */
  float return_to_go;             /* that the last decision was conditioned on */
  float logits[SPIKE_ACTIONS];    /* of the last decision */
  uint32_t step, episode;         /* decisions of this episode, and its number, from 0 */
  uint64_t decisions, spikes;     /* of the session */
  double episode_return;          /* rewards of this episode so far */
#if SPIKE_DISCRETE
  float probabilities[SPIKE_ACTIONS];
#endif
} spike_report;

typedef struct {
  float return_to_go;
  float observation[SPIKE_OBSERVATIONS];
  spike_action action;
} spike_timestep;

/* Everything that changes: a session, its keys and values, and the memory of a decision. Without
   pointers, so that it may be copied. Use the functions below; its fields are no interface. */
typedef struct {
  /* The value of the session. */
  uint64_t seed, decisions, spikes, episode_spikes;
  double session_target, target_return, return_to_go, episode_return;
  double episode_energy, energy;
  uint32_t is_open, step, episode, timesteps, oldest, has_delta, context_held, context_first;
  uint32_t head_bytes, text_bytes, end_bytes; /* of text before the head, of text, of end_text */
  float temperature;
  spike_costs last_costs, action_costs;
  float last_return_to_go, logits[SPIKE_ACTIONS];
  spike_action answered;
  float head_delta[SPIKE_ACTIONS * SPIKE_HIDDEN];
  spike_timestep history[SPIKE_HISTORY]; /* a ring */
  /* The memory of a decision: numbers of 32 bits here, others below. */
  int32_t x[SPIKE_HIDDEN];            /* the residual stream */
  int32_t sums[SPIKE_WIDEST];         /* the outputs of a map */
  int32_t weights[3 * SPIKE_CONTEXT]; /* of the keys of a row */
  int32_t gates[SPIKE_HEADS];
  int32_t merged[SPIKE_MERGED]; /* the heads, summed over the ticks */
  /* The keys and values of the last timesteps, a ring: [layers][slots][heads][ticks][words]. */
  spike_word keys[SPIKE_LAYERS][3 * SPIKE_CONTEXT][SPIKE_HEADS][SPIKE_TICKS][SPIKE_WORDS];
  spike_word values[SPIKE_LAYERS][3 * SPIKE_CONTEXT][SPIKE_HEADS][SPIKE_TICKS][SPIKE_WORDS];
  spike_word query[SPIKE_HEADS][SPIKE_TICKS][SPIKE_WORDS];
  int16_t input[SPIKE_WIDEST];              /* of a map */
  int16_t drive[SPIKE_TICKS][SPIKE_WIDEST]; /* the currents into a population */
  uint8_t period[SPIKE_HIDDEN];             /* of the neurons of a coder; 0: silent */
  /* Parts of the session's value that no decision reads: CBOR. */
  uint8_t text[SPIKE_TEXT_BYTES], end_text[SPIKE_END_BYTES];
} spike_state;

/* Prepares a state. SPIKE_ARITHMETIC if the compiler's float32 is not exact: then compile with
   -ffp-contract=off, without -ffast-math, and on 32-bit x86 with -msse2 -mfpmath=sse. */
spike_error spike_init(spike_state* state);

/* Opens a session, at the first step of its first episode. A temperature of 0 chooses the best
   action; others draw it, and `seed` is the key of the draws. */
spike_error spike_open(spike_state* state, double target_return, uint64_t seed, float temperature);

/* Decides the next step from an observation [SPIKE_OBSERVATIONS] in the units of the environment.
   `reward` is what the action before has earned, and `executed` the action that was executed
   instead of the answered one; null: the answered one was. Both are ignored at the first step. */
spike_error spike_decide(spike_state* state, const float* observation, double reward,
                         const spike_action* executed, spike_action* action);

/* Ends the episode; the next decision is the first of another one. `reward` is of the last action,
   `target_return` of the next episode; null: the session's. `terminated` is 0 if the episode was
   cut off. */
spike_error spike_end_episode(spike_state* state, double reward, int terminated,
                              const spike_action* executed, const double* target_return);

/* Reports what the last decision cost. */
spike_error spike_counts(const spike_state* state, spike_report* report);

/* Writes the value of the session, which ExportSession of a server would return, and sets `size` to
   its bytes. A `value` of null only sets the size. */
spike_error spike_export(const spike_state* state, uint8_t* value, size_t capacity, size_t* size);

/* Continues a session from its value. The next decision also computes the tokens of its history. */
spike_error spike_import(spike_state* state, const uint8_t* value, size_t size);

#ifdef __cplusplus
}
#endif
