// Names how much of a session survives the process that holds it.
#pragma once

#include <array>

#include "core/base/enum_names.h"

namespace spikeserve {

enum class Durability {
  kNone,   // the session lives and ends with its process
  kAsync,  // a decision is answered at once, and stored soon after
  kSync,   // a decision is answered when it is stored
};

constexpr std::array<EnumName<Durability>, 3> EnumNames(Durability) {
  return {
      {{Durability::kNone, "none"}, {Durability::kAsync, "async"}, {Durability::kSync, "sync"}}};
}

}  // namespace spikeserve
