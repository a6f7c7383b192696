#include "train/progress_bar.h"

#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <string>

#include "absl/strings/str_format.h"

namespace spikeserve {
namespace {

constexpr int kWidth = 30;  // characters of the bar
constexpr int kLinesWithoutTerminal = 20;

}  // namespace

ProgressBar::ProgressBar(int total, int done)
    : total_(total),
      first_(done),
      terminal_(isatty(STDERR_FILENO) == 1),
      begin_(std::chrono::steady_clock::now()) {}

void ProgressBar::Update(int done, absl::string_view text) {
  const int interval = std::max(1, total_ / kLinesWithoutTerminal);
  if (!terminal_ && done != total_ && done % interval != 0) return;
  const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - begin_;
  const double per_step = elapsed.count() / std::max(1, done - first_);
  const int filled = static_cast<int>(static_cast<int64_t>(kWidth) * done / total_);
  const std::string line = absl::StrFormat(
      "%d/%d [%s%s] %s, %.2f s/it, %.0f s left", done, total_, std::string(filled, '='),
      std::string(kWidth - filled, ' '), text, per_step, per_step * (total_ - done));
  absl::FPrintF(stderr, terminal_ ? "\r%s\x1b[K" : "%s\n", line);
  if (terminal_ && done == total_) absl::FPrintF(stderr, "\n");
}

}  // namespace spikeserve
