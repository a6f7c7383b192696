// main.c as a sketch, for play.py on the serial port of the board. The library is what
// `spikectl emit-c --kind=arduino` writes.
#include <spike_policy.h>
#include <string.h>

static spike_state state;

static void read_bytes(void* to, size_t size) {
  while (size > 0) {
    const size_t count = Serial.readBytes((char*)to, size);
    to = (char*)to + count;
    size -= count;
  }
}

void setup() {
  Serial.begin(115200);
  spike_init(&state);
  spike_open(&state, SPIKE_TARGET_RETURN, /*seed=*/0, /*temperature=*/0.0f);
}

void loop() {
  char event; // 's', 't' or 'e', as in main.c
  double reward;
  float observation[SPIKE_OBSERVATIONS];
  spike_action action;
  read_bytes(&event, 1);
  read_bytes(&reward, sizeof(reward));
  read_bytes(observation, sizeof(observation));
  if (event != 's') spike_end_episode(&state, reward, event == 't', NULL, NULL);
  // A refused step changes nothing. This action is then the safe one of your robot.
  if (spike_decide(&state, observation, reward, NULL, &action) != SPIKE_OK) memset(&action, 0, sizeof(action));
  Serial.write((const uint8_t*)&action, sizeof(action));
}
