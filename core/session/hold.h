// Defines what holds a session. Plain values.
#pragma once

#include <string>

namespace spikeserve {

// While a session is held, it answers with the neutral action and learns nothing.
struct Hold {
  std::string id;
  std::string reason;  // for people

  friend bool operator==(const Hold&, const Hold&) = default;
};

}  // namespace spikeserve
