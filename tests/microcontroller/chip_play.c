/* Plays a stream of calls (chip_stream.cc) on the C of a policy. Prints in hexadecimal: the hash of
   its answers, the mean and the most instructions of a decision, the bytes of the stack, and the
   mean picojoules of a decision by int_45nm and by int_sram_45nm.

   The stream, little-endian, without padding; a flag is a byte, and an action comes behind one:

   'O' target f64, seed u64, temperature f32      spike_open
   'I' size u32, bytes                            spike_import, into a state of other contents
   'D' observation, reward f64, executed          spike_decide; the answer and spike_counts are
   hashed 'N' observation, reward f64                    spike_decide, which must fail and change
   nothing 'E' reward f64, terminated flag, target f64    spike_end_episode 'X' spike_export, which
   is hashed 'P'                                            the last action and spike_export,
   printed on a line 'Q'                                            end */
#include <string.h>

#include "port.h"
#include "spike_policy.h"

#define MOST_VALUE                                                                      \
  (1024 + SPIKE_TEXT_BYTES + SPIKE_END_BYTES + 5 * SPIKE_ACTIONS * (SPIKE_HIDDEN + 2) + \
   SPIKE_HISTORY * (16 + 5 * (SPIKE_OBSERVATIONS + SPIKE_ACTIONS)))

static spike_state state;
static spike_action action;
static uint8_t value[MOST_VALUE];
static uint64_t hash = 0xcbf29ce484222325u, instructions;
static uint32_t decisions, most_instructions;
static double joules, joules_with_memory;

/* Returns where byte `i` of numbers of `width` bytes lies if they are stored with the least
   significant byte first. */
static size_t place(size_t i, size_t width) {
  const uint16_t one = 1;
  return *(const uint8_t*)&one == 1 ? i : i ^ (width - 1);
}

/* Adds `size` bytes of numbers of `width` bytes to the hash. */
static void add(const void* numbers, size_t size, size_t width) {
  const uint8_t* bytes = numbers;
  size_t i;
  for (i = 0; i < size; ++i) hash = (hash ^ bytes[place(i, width)]) * 0x100000001b3u;
}

static void take(void* numbers, size_t size, size_t width) {
  uint8_t* bytes = numbers;
  size_t i;
  for (i = 0; i < size; ++i) port_read(&bytes[place(i, width)], 1);
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
  take(&number, 8, 8);
  return number;
}

static void decide(int must_fail) {
  float observation[SPIKE_OBSERVATIONS];
  spike_action executed;
  const spike_action* given = NULL;
  spike_report report;
  spike_error error;
  double reward;
  uint32_t clock;
  take(observation, sizeof(observation), 4);
  reward = take_double();
  if (!must_fail && take_byte()) {
    take(&executed, sizeof(executed), 4);
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
  add(&action, sizeof(action), 4);
  add(&report.return_to_go, 4, 4);
  add(report.logits, sizeof(report.logits), 4);
#if SPIKE_DISCRETE
  add(report.probabilities, sizeof(report.probabilities), 4);
#endif
  add(&report.last, sizeof(report.last), 4);
  joules += report.int_45nm;
  joules_with_memory += report.int_sram_45nm;
  add(&report.int_45nm, 8, 8);
  add(&report.int_sram_45nm, 8, 8);
}

static void open_session(void) {
  const double target = take_double();
  uint64_t seed;
  float temperature;
  take(&seed, 8, 8);
  take(&temperature, 4, 4);
  require(spike_open(&state, target, seed, temperature) == SPIKE_OK, "spike_open\n");
}

static void import_session(void) {
  uint32_t size;
  take(&size, 4, 4);
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

static void print_hexadecimal(const uint8_t* bytes, size_t size) {
  char text[65];
  size_t i, used = 0;
  for (i = 0; i < size; ++i) {
    text[used++] = "0123456789abcdef"[bytes[i] >> 4];
    text[used++] = "0123456789abcdef"[bytes[i] & 15];
    if (used < 64 && i + 1 < size) continue;
    text[used] = 0;
    port_print(text);
    used = 0;
  }
}

static void print_number(uint64_t number, const char* after) {
  uint8_t bytes[8];
  int i;
  for (i = 0; i < 8; ++i) bytes[i] = (uint8_t)(number >> (56 - 8 * i));
  print_hexadecimal(bytes, 8);
  port_print(after);
}

static size_t export_session(void) {
  size_t size;
  require(spike_export(&state, value, sizeof(value), &size) == SPIKE_OK, "spike_export\n");
  return size;
}

int main(void) {
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
        add(value, export_session(), 1);
        break;
      case 'P':
        print_hexadecimal((const uint8_t*)&action, sizeof(action));
        port_print(" ");
        print_hexadecimal(value, export_session());
        port_print("\n");
        break;
      default:
        require(0, "the stream\n");
    }
  }
  print_number(hash, " ");
  print_number(decisions == 0 ? 0 : instructions / decisions, " ");
  print_number(most_instructions, " ");
  print_number(port_stack(), " ");
  print_number(decisions == 0 ? 0 : (uint64_t)(1e12 * joules / decisions), " ");
  print_number(decisions == 0 ? 0 : (uint64_t)(1e12 * joules_with_memory / decisions), "\n");
  port_exit(0);
  return 0;
}
