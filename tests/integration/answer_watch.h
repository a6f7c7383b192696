// Notes the newest answer of ActStream that has arrived, for tests.
#pragma once

#include <cstdint>

namespace spikeserve {

// Watches all channels that are made afterwards. Only once.
void WatchAnswers();

// Returns its step in the episode, or -1. Thread-safe.
int64_t NewestAnswer();

}  // namespace spikeserve
