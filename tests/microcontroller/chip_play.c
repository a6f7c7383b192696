/* Plays a stream of calls (chip_stream.cc) on the C of a policy. Prints in hexadecimal: the hash of its answers, the mean and
   the most instructions of a decision, the bytes of the stack, and the mean picojoules of a decision by int_45nm.

   The stream, little-endian, without padding; a flag is a byte, and an action comes behind one:

   'O' target f64, seed u64, temperature f32      spike_open
   'I' size u32, bytes                            spike_import, into a state of other contents
   'D' observation, reward f64, executed          spike_decide; the answer and spike_counts are hashed
   'N' observation, reward f64                    spike_decide, which must fail and change nothing
   'E' reward f64, terminated flag, target f64    spike_end_episode
   'X'                                            spike_export, which is hashed
   'Q'                                            end */
#include <string.h>

#include "port.h"
#include "spike_policy.h"

#define MOST_VALUE                                                                      \
  (1024 + SPIKE_TEXT_BYTES + SPIKE_END_BYTES + 5 * SPIKE_ACTIONS * (SPIKE_HIDDEN + 2) + \
   SPIKE_HISTORY * (16 + 5 * (SPIKE_OBSERVATIONS + SPIKE_ACTIONS)))

static spike_state state;
static uint8_t value[MOST_VALUE];
static uint64_t hash = 0xcbf29ce484222325u, instructions;
static uint32_t decisions, most_instructions;
static double joules;

static void add(const void* bytes, size_t size) {
  const uint8_t* byte = bytes;
  while (size-- > 0) hash = (hash ^ *byte++) * 0x100000001b3u;
}

static void require(int condition, const char* what) {
  if (condition) return;
  port_print(what);
  port_exit(1);
}

static uint8_t take_byte(void) {
  uint8_t byte = 0;
  port_read(&byte, 1);
  return byte;
}

static double take_double(void) {
  double number;
  port_read(&number, 8);
  return number;
}

static void decide(int must_fail) {
  float observation[SPIKE_OBSERVATIONS];
  spike_action executed, action;
  const spike_action* given = NULL;
  spike_report report;
  spike_error error;
  double reward;
  uint32_t clock;
  port_read(observation, sizeof(observation));
  reward = take_double();
  if (!must_fail && take_byte()) {
    port_read(&executed, sizeof(executed));
    given = &executed;
  }
  clock = port_clock();
  error = spike_decide(&state, observation, reward, given, &action);
  clock = port_since(clock);
  require((error == SPIKE_OK) == !must_fail, "spike_decide\n");
  if (must_fail) return;
  ++decisions;
  instructions += clock;
  if (clock > most_instructions) most_instructions = clock;
  require(spike_counts(&state, &report) == SPIKE_OK, "spike_counts\n");
  add(&action, sizeof(action));
  add(&report.return_to_go, 4);
  add(report.logits, sizeof(report.logits));
#if SPIKE_DISCRETE
  add(report.probabilities, sizeof(report.probabilities));
#endif
  add(&report.last, sizeof(report.last));
  joules += report.int_45nm;
  add(&report.int_45nm, 8);
  add(&report.int_sram_45nm, 8);
}

static void open_session(void) {
  const double target = take_double();
  uint64_t seed;
  float temperature;
  port_read(&seed, 8);
  port_read(&temperature, 4);
  require(spike_open(&state, target, seed, temperature) == SPIKE_OK, "spike_open\n");
}

static void import_session(void) {
  uint32_t size;
  port_read(&size, 4);
  require(size <= sizeof(value), "the buffer for a value is too small\n");
  port_read(value, size);
  memset(&state, 0x55, sizeof(state));
  require(spike_import(&state, value, size) == SPIKE_OK, "spike_import\n");
}

static void end_episode(void) {
  const double reward = take_double();
  const int terminated = take_byte();
  double target = 0.0;
  const double* given = NULL;
  if (take_byte()) {
    target = take_double();
    given = &target;
  }
  require(spike_end_episode(&state, reward, terminated, NULL, given) == SPIKE_OK,
          "spike_end_episode\n");
}

static void print_hexadecimal(uint64_t number, int last) {
  char text[18];
  int i;
  for (i = 0; i < 16; ++i) text[i] = "0123456789abcdef"[(number >> (60 - 4 * i)) & 15];
  text[16] = (char)last;
  text[17] = 0;
  port_print(text);
}

int main(void) {
  size_t size;
  int call;
  port_open();
  require(spike_init(&state) == SPIKE_OK, "spike_init\n");
  require(spike_end_episode(&state, 0.0, 0, NULL, NULL) == SPIKE_ORDER, "the order of calls\n");
  while ((call = take_byte()) != 'Q') {
    switch (call) {
      case 'O':
        open_session();
        break;
      case 'I':
        import_session();
        break;
      case 'D':
        decide(0);
        break;
      case 'N':
        decide(1);
        break;
      case 'E':
        end_episode();
        break;
      case 'X':
        require(spike_export(&state, value, sizeof(value), &size) == SPIKE_OK, "spike_export\n");
        add(value, size);
        break;
      default:
        require(0, "the stream\n");
    }
  }
  print_hexadecimal(hash, ' ');
  print_hexadecimal(decisions == 0 ? 0 : instructions / decisions, ' ');
  print_hexadecimal(most_instructions, ' ');
  print_hexadecimal(port_stack(), ' ');
  print_hexadecimal(decisions == 0 ? 0 : (uint64_t)(1e12 * joules / decisions), '\n');
  port_exit(0);
  return 0;
}
