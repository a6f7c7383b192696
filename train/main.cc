// spiketrain: records data, trains policies on it, and plays them.

#include <malloc.h>

#include <cstdio>
#include <filesystem>
#include <limits>
#include <string>
#include <vector>

#include "absl/flags/parse.h"
#include "absl/flags/usage.h"
#include "absl/strings/str_cat.h"
#include "train/commands.h"

namespace spikeserve {
namespace {

constexpr char kUsage[] =
    "trains spiking decision transformers.\n\n"
    "  spiketrain expert --env=ID [--episodes --seed --tables]   play the expert that data come "
    "from\n"
    "  spiketrain dataset --out=FILE [--env --seed --steps]      record expert and random "
    "episodes\n"
    "  spiketrain dataset --out=FILE --recordings=DIR            or take what a server recorded\n"
    "  spiketrain train --out=DIR [--data=FILE] [--mode] [...]   train a policy\n"
    "  spiketrain eval --policy=FILE [--episodes --seed]         play a policy in closed loop\n"
    "  spiketrain report --out=DIR [--smoke]                     the paper's tables, measured\n";

// Keeps freed memory instead of giving it back to the kernel: every iteration allocates the same
// large tensors, and faulting their pages in anew costs a fifth of its time.
void KeepFreedMemory() {
  mallopt(M_MMAP_MAX, 0);
  mallopt(M_TRIM_THRESHOLD, std::numeric_limits<int>::max());
  mallopt(M_TOP_PAD, 64 << 20);
}

absl::Status Run(const std::vector<char*>& positional, const std::string& command_line) {
  if (positional.size() != 2) {
    return absl::InvalidArgumentError(
        "command: expected one of expert, dataset, train, eval, report");
  }
  const std::string command = positional[1];
  if (command == "expert") return ExpertCommand();
  if (command == "dataset") return DatasetCommand();
  if (command == "train") return TrainCommand(command_line);
  if (command == "eval") return EvalCommand();
  if (command == "report") return ReportCommand(command_line);
  return absl::InvalidArgumentError(absl::StrCat(
      "command: expected expert, dataset, train, eval or report, received '", command, "'"));
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::KeepFreedMemory();
  absl::SetProgramUsageMessage(spikeserve::kUsage);
  std::string command_line = std::filesystem::path(argv[0]).filename();
  for (int i = 1; i < argc; ++i) absl::StrAppend(&command_line, " ", argv[i]);
  const absl::Status status = spikeserve::Run(absl::ParseCommandLine(argc, argv), command_line);
  if (status.ok()) return 0;
  std::fprintf(stderr, "spiketrain: %s\n", std::string(status.message()).c_str());
  return 1;
}
