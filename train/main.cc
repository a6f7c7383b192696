// spiketrain: records data, trains policies on it, quantizes and plays them. Every subcommand has a
// file of its own.
#include <exception>
#include <iostream>

#include "absl/strings/string_view.h"
#include "core/cli/printable_output.h"
#include "core/cli/program.h"
#include "train/commands.h"
#include "train/trainer/device.h"
#include "train/trainer/memory.h"

int main(int argc, char** argv) {
  spikeserve::KeepFreedMemory();
  spikeserve::UseThreads(1);  // a training may have more
  const spikeserve::PrintableOutput output;
  spikeserve::Program program("spiketrain", "Trains Spiking Decision Transformers");
  spikeserve::AddExpertCommand(program);
  spikeserve::AddDatasetCommand(program);
  spikeserve::AddTrainCommand(program);
  spikeserve::AddQuantizeCommand(program);
  spikeserve::AddEvalCommand(program);
  spikeserve::AddCompareCommand(program);
  spikeserve::AddNeuroBenchCommand(program);
  spikeserve::AddOpeCommand(program);
  spikeserve::AddAccountCommand(program);
  try {
    return program.Run(argc, argv);
  } catch (const std::exception& error) {         // of libtorch, for example without enough memory
    const absl::string_view what = error.what();  // a trace of the stack follows its first line
    std::cerr << "spiketrain: " << what.substr(0, what.find('\n')) << std::endl;
    return 1;
  }
}
