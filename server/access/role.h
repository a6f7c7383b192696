// The roles that a token can have.
#pragma once

#include <array>

#include "core/base/enum_names.h"

namespace spikeserve {

enum class Role {
  kAgent,     // opens sessions and uses the sessions of its tenant
  kViewer,    // reads policies, sessions, heads, metrics and the status page
  kOperator,  // may call every method
};

constexpr std::array<EnumName<Role>, 3> EnumNames(Role) {
  return {{{Role::kAgent, "agent"}, {Role::kViewer, "viewer"}, {Role::kOperator, "operator"}}};
}

}  // namespace spikeserve
