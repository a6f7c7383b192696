// Shows the progress of a long command on standard error: as a bar if that is a terminal, otherwise
// as an occasional line.
//
// Not thread-safe.
#pragma once

#include <chrono>

#include "absl/strings/string_view.h"

namespace spikeserve {

class ProgressBar {
 public:
  // Shows the progress of `total` steps, of which `done` were finished by an earlier run.
  ProgressBar(int total, int done);

  // Shows that `done` steps are finished, with `text` after the bar.
  void Update(int done, absl::string_view text);

 private:
  const int total_;
  const int first_;
  const bool terminal_;
  const std::chrono::steady_clock::time_point begin_;
};

}  // namespace spikeserve
