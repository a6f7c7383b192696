// A child process with its output at hand, for tests that run the real programs.
//
// Not thread-safe; each test owns its processes.
#ifndef TESTS_INTEGRATION_SUBPROCESS_H_
#define TESTS_INTEGRATION_SUBPROCESS_H_

#include <sys/types.h>

#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace spikeserve {

class Subprocess {
 public:
  // Starts `arguments[0]` with the rest as its arguments.
  static absl::StatusOr<std::unique_ptr<Subprocess>> Start(
      const std::vector<std::string>& arguments);

  // Kills the process if it still runs.
  ~Subprocess();
  Subprocess(const Subprocess&) = delete;
  Subprocess& operator=(const Subprocess&) = delete;

  // The next line of standard output without its newline, waited for; nullopt at its end.
  std::optional<std::string> ReadLine();

  // Everything written to standard error so far.
  std::string Errors() const;

  void Signal(int signal);

  // Waits for the end and returns the exit code, or 128 + the number of the signal that killed it.
  int Wait();

 private:
  Subprocess() = default;

  struct CloseFile {
    void operator()(FILE* file) const { fclose(file); }
  };
  using File = std::unique_ptr<FILE, CloseFile>;

  pid_t pid_ = -1;
  File output_;  // the read end of a pipe
  File errors_;  // a nameless temporary file
  std::optional<int> exit_code_;
};

// What a process left behind.
struct Finished {
  int exit_code = 0;
  std::string output;
  std::string errors;
};

// Runs a program to its end.
absl::StatusOr<Finished> RunToEnd(const std::vector<std::string>& arguments);

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_SUBPROCESS_H_
