// Generates the manual page of a program.
//
// A free function without shared state; safe to call from many threads.
#ifndef CORE_CLI_MANUAL_PAGE_H_
#define CORE_CLI_MANUAL_PAGE_H_

#include <string>

#include "core/cli/command_tree.h"

namespace spikeserve {

// Returns a page of section 1 in the man(7) language. Its date is the current date, or the date in
// the environment variable SOURCE_DATE_EPOCH, which makes builds reproducible.
std::string ManualPage(const CommandInfo& program);

}  // namespace spikeserve

#endif  // CORE_CLI_MANUAL_PAGE_H_
