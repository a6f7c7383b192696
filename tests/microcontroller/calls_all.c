/* Calls all functions of a policy, to measure what they need of the flash. */
#include "port.h"
#include "spike_policy.h"

static spike_state state;

int main(void) {
  float observation[SPIKE_OBSERVATIONS] = {0};
  spike_action action;
  spike_report report;
  size_t size;
  spike_init(&state);
  spike_open(&state, 0.0, 0, 0.0f);
  spike_decide(&state, observation, 0.0, NULL, &action);
  spike_counts(&state, &report);
  spike_end_episode(&state, 0.0, 0, NULL, NULL);
  spike_export(&state, NULL, 0, &size);
  return (int)spike_import(&state, NULL, 0);
}
