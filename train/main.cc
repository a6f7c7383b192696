// spiketrain: records data, trains policies on it, quantizes and plays them. Every subcommand has a
// file of its own.
#include <malloc.h>

#include <limits>

#include "core/cli/program.h"
#include "train/commands.h"

namespace spikeserve {
namespace {

// Keeps freed memory instead of returning it to the kernel. Every iteration allocates the same
// large tensors, and page faults for new memory would take a fifth of its time.
void KeepFreedMemory() {
  mallopt(M_MMAP_MAX, 0);
  mallopt(M_TRIM_THRESHOLD, std::numeric_limits<int>::max());
  mallopt(M_TOP_PAD, 64 << 20);
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::KeepFreedMemory();
  spikeserve::Program program("spiketrain", "Trains Spiking Decision Transformers");
  spikeserve::AddExpertCommand(program);
  spikeserve::AddDatasetCommand(program);
  spikeserve::AddTrainCommand(program);
  spikeserve::AddQuantizeCommand(program);
  spikeserve::AddEvalCommand(program);
  spikeserve::AddCompareCommand(program);
  spikeserve::AddNeuroBenchCommand(program);
  spikeserve::AddAccountCommand(program);
  spikeserve::AddReportCommand(program);
  return program.Run(argc, argv);
}
