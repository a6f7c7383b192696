/* A microcontroller that decides: it reads steps from its serial port, and writes actions to it
 * (play.py). */
#include <string.h>

#include "board.h"
#include "spike_policy.h"

static spike_state state; /* nothing else needs RAM but the stack */

int main(void) {
  if (spike_init(&state) != SPIKE_OK) return 1;
  if (spike_open(&state, SPIKE_TARGET_RETURN, /*seed=*/0, /*temperature=*/0.0f) != SPIKE_OK)
    return 1;
  for (;;) {
    char event; /* 's': a step; 't' and 'e': the first step after an episode that terminated, or was
                   cut off */
    double reward;
    float observation[SPIKE_OBSERVATIONS];
    spike_action action;
    memset(&action, 0, sizeof(action));
    board_read(&event, 1);
    board_read(&reward, sizeof(reward));
    board_read(observation, sizeof(observation));
    if (event != 's') spike_end_episode(&state, reward, event == 't', NULL, NULL);
    /* A refused step, for example with NaN, changes nothing. This action is then the safe one of
     * your robot. */
    if (spike_decide(&state, observation, reward, NULL, &action) != SPIKE_OK)
      memset(&action, 0, sizeof(action));
    board_write(&action, sizeof(action));
  }
}
