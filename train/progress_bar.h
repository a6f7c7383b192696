// How far a long command is, on standard error: a bar on a terminal, now and then a line elsewhere.
//
// Not thread-safe.
#ifndef TRAIN_PROGRESS_BAR_H_
#define TRAIN_PROGRESS_BAR_H_

#include <chrono>

#include "absl/strings/string_view.h"

namespace spikeserve {

class ProgressBar {
 public:
  // Work of `total` steps of which `done` were done before.
  ProgressBar(int total, int done);

  // Shows that `done` steps are done, with `text` beside the bar.
  void Update(int done, absl::string_view text);

 private:
  const int total_;
  const int first_;
  const bool terminal_;
  const std::chrono::steady_clock::time_point begin_;
};

}  // namespace spikeserve

#endif  // TRAIN_PROGRESS_BAR_H_
