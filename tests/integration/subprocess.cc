#include "tests/integration/subprocess.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <cstring>

#include "absl/cleanup/cleanup.h"
#include "absl/strings/str_cat.h"

extern char** environ;

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Subprocess>> Subprocess::Start(
    const std::vector<std::string>& arguments) {
  auto process = std::unique_ptr<Subprocess>(new Subprocess());
  int pipe_ends[2];
  if (pipe2(pipe_ends, O_CLOEXEC) != 0) return absl::ErrnoToStatus(errno, "pipe");
  process->output_.reset(fdopen(pipe_ends[0], "r"));
  const auto close_write_end = absl::MakeCleanup([&] { close(pipe_ends[1]); });
  process->errors_.reset(tmpfile());
  if (process->errors_ == nullptr) return absl::ErrnoToStatus(errno, "tmpfile");

  std::vector<char*> argv;
  for (const std::string& argument : arguments) {
    argv.push_back(const_cast<char*>(argument.c_str()));  // posix_spawn does not write to it
  }
  argv.push_back(nullptr);

  posix_spawn_file_actions_t actions;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_adddup2(&actions, pipe_ends[1], STDOUT_FILENO);
  posix_spawn_file_actions_adddup2(&actions, fileno(process->errors_.get()), STDERR_FILENO);
  const int error = posix_spawn(&process->pid_, argv[0], &actions, nullptr, argv.data(), environ);
  posix_spawn_file_actions_destroy(&actions);
  if (error != 0) {
    process->exit_code_ = -1;  // no process to wait for
    return absl::ErrnoToStatus(error, absl::StrCat("spawn ", arguments[0]));
  }
  return process;
}

Subprocess::~Subprocess() {
  if (exit_code_.has_value()) return;
  Signal(SIGKILL);
  Wait();
}

std::optional<std::string> Subprocess::ReadLine() {
  char* line = nullptr;
  size_t capacity = 0;
  const ssize_t length = getline(&line, &capacity, output_.get());
  const auto free_line = absl::MakeCleanup([&] { free(line); });
  if (length < 0) return std::nullopt;
  std::string text(line, static_cast<size_t>(length));
  if (text.ends_with('\n')) text.pop_back();
  return text;
}

std::string Subprocess::Errors() const {
  const int file = fileno(errors_.get());
  std::string text;
  char block[4096];
  ssize_t length;
  while ((length = pread(file, block, sizeof(block), static_cast<off_t>(text.size()))) > 0) {
    text.append(block, static_cast<size_t>(length));
  }
  return text;
}

void Subprocess::Signal(int signal) {
  if (!exit_code_.has_value()) kill(pid_, signal);
}

int Subprocess::Wait() {
  if (exit_code_.has_value()) return *exit_code_;
  int status = 0;
  while (waitpid(pid_, &status, 0) < 0 && errno == EINTR) {
  }
  exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
  return *exit_code_;
}

absl::StatusOr<Finished> RunToEnd(const std::vector<std::string>& arguments) {
  auto process = Subprocess::Start(arguments);
  if (!process.ok()) return process.status();
  Finished finished;
  while (std::optional<std::string> line = (*process)->ReadLine()) {
    absl::StrAppend(&finished.output, *line, "\n");
  }
  finished.exit_code = (*process)->Wait();
  finished.errors = (*process)->Errors();
  return finished;
}

}  // namespace spikeserve
