/* Imports damaged values of a session whose checksums are right again. A value that is refused must
   change nothing; with one that is taken, the session must go on. Reads a value from the file that
   its argument names. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "spike_policy.h"

static spike_state state, before;
static uint8_t value[1 << 20], damaged[1 << 20];
static uint64_t random_state = 1;

static uint32_t draw(uint32_t below) {
  random_state = random_state * 6364136223846793005u + 1442695040888963407u;
  return (uint32_t)(random_state >> 33) % below;
}

static size_t damage(size_t size) {
  const uint32_t changes = 1 + draw(3);
  uint64_t hash = 0xcbf29ce484222325u;
  uint32_t i;
  memcpy(damaged, value, size);
  if (draw(4) == 0) size -= draw((uint32_t)size);
  for (i = 0; i < changes && size > 0; ++i) {
    const uint32_t at = draw(draw(2) == 0 ? (uint32_t)size : size < 200 ? (uint32_t)size : 200);
    damaged[at] = (uint8_t)(draw(2) == 0 ? draw(256) : damaged[at] ^ 1u << draw(8));
  }
  for (i = 0; i < size; ++i) hash = (hash ^ damaged[i]) * 0x100000001b3u;
  for (i = 0; i < 8; ++i) damaged[size + i] = (uint8_t)(hash >> (8 * i));
  return size + 8;
}

int main(int argc, char** argv) {
  float observation[SPIKE_OBSERVATIONS] = {0};
  unsigned taken = 0, refused = 0, round;
  FILE* file = argc == 2 ? fopen(argv[1], "rb") : NULL;
  const size_t size = file == NULL ? 0 : fread(value, 1, sizeof(value) - 8, file);
  if (size < 8 || spike_init(&state) != SPIKE_OK || spike_import(&state, value, size) != SPIKE_OK)
    return 1;
  for (round = 0; round < 20000; ++round) {
    const size_t damaged_size = damage(size - 8);
    spike_action action;
    memcpy(&before, &state, sizeof(state));
    if (spike_import(&state, damaged, damaged_size) != SPIKE_OK) {
      if (memcmp(&before, &state, sizeof(state)) != 0) return 2;
      ++refused;
      continue;
    }
    ++taken;
    if (taken % 16 == 0) {
      const spike_error error = spike_decide(&state, observation, 0.0, NULL, &action);
      size_t exported;
      if (error != SPIKE_OK && error != SPIKE_NUMBER) return 3;
      if (spike_export(&state, damaged, sizeof(damaged), &exported) != SPIKE_OK) return 4;
      if (spike_import(&state, damaged, exported) != SPIKE_OK) return 5;
    }
    if (spike_import(&state, value, size) != SPIKE_OK) return 6;
  }
  printf("%u taken, %u refused\n", taken, refused);
  return taken > 100 && refused > 100 ? 0 : 7;
}
