// The manual page of a program.
//
// A free function without shared state; safe to call from many threads.
#ifndef CORE_CLI_MANUAL_PAGE_H_
#define CORE_CLI_MANUAL_PAGE_H_

#include <string>

#include "core/cli/command_tree.h"

namespace spikeserve {

// Returns the page in the man(7) language, section 1. Its date is today's, or that of the
// environment variable SOURCE_DATE_EPOCH, with which builds can be reproduced.
std::string ManualPage(const CommandInfo& program);

}  // namespace spikeserve

#endif  // CORE_CLI_MANUAL_PAGE_H_
