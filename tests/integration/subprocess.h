// A child process whose output can be read, for tests that run the real programs.
//
// Not thread-safe.
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
  // Starts the program `arguments[0]` with the other elements as its arguments.
  static absl::StatusOr<std::unique_ptr<Subprocess>> Start(
      const std::vector<std::string>& arguments);

  // Kills the process if it is still running.
  ~Subprocess();
  Subprocess(const Subprocess&) = delete;
  Subprocess& operator=(const Subprocess&) = delete;

  // Waits for the next line of standard output and returns it without the newline; nullopt at the
  // end of the output.
  std::optional<std::string> ReadLine();

  // Returns everything that was written to standard error so far.
  std::string Errors() const;

  // Sends a signal to the process.
  void Signal(int signal);

  // Waits for the process to exit. Returns its exit code, or 128 + the number of the signal that
  // killed it.
  int Wait();

 private:
  Subprocess() = default;

  struct CloseFile {
    void operator()(FILE* file) const { fclose(file); }
  };
  using File = std::unique_ptr<FILE, CloseFile>;

  pid_t pid_ = -1;
  File output_;  // the read end of a pipe
  File errors_;  // an anonymous temporary file
  std::optional<int> exit_code_;
};

// The result of a process that has exited.
struct Finished {
  int exit_code = 0;
  std::string output;
  std::string errors;
};

// Runs a program and waits until it exits.
absl::StatusOr<Finished> RunToEnd(const std::vector<std::string>& arguments);

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_SUBPROCESS_H_
