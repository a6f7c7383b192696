#include "train/data/child_reader.h"

#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <exception>
#include <fstream>
#include <new>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status_macros.h"
#include "core/dataset/dataset_cbor.h"

namespace spikeserve {
namespace {

constexpr rlim_t kMostSeconds = 600;  // of the processor

// Returns the bytes that this process has reserved for data, as RLIMIT_DATA counts them.
rlim_t DataBytes() {
  std::ifstream file("/proc/self/statm");
  rlim_t pages = 0;
  for (int field = 0; field < 6; ++field) file >> pages;
  return pages * static_cast<rlim_t>(sysconf(_SC_PAGESIZE));
}

void Limit(int resource, rlim_t most) {
  const rlimit limit = {.rlim_cur = most, .rlim_max = most};
  setrlimit(static_cast<__rlimit_resource>(resource), &limit);
}

bool WriteAll(int fd, absl::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t written = write(fd, bytes.data(), bytes.size());
    if (written < 0 && errno == EINTR) continue;
    if (written <= 0) return false;
    bytes.remove_prefix(static_cast<size_t>(written));
  }
  return true;
}

// Returns the dataset in CBOR.
absl::StatusOr<std::string> ReadOrCatch(absl::FunctionRef<absl::StatusOr<Dataset>()> read) {
  try {
    ASSIGN_OR_RETURN(const Dataset dataset, read());
    return SerializeDataset(dataset);
  } catch (const std::bad_alloc&) {
    return absl::ResourceExhaustedError(
        "expected data that fits into half of the machine's memory, received more");
  } catch (const std::exception& error) {
    return absl::InvalidArgumentError(error.what());
  }
}

// Writes a byte, the code of the result, and after it the dataset or the message of the error.
bool WriteResult(int fd, const absl::StatusOr<std::string>& dataset) {
  const char code = static_cast<char>(dataset.status().code());
  const absl::string_view rest = dataset.ok() ? *dataset : dataset.status().message();
  return WriteAll(fd, absl::string_view(&code, 1)) && WriteAll(fd, rest);
}

[[noreturn]] void RunChild(int fd, absl::FunctionRef<absl::StatusOr<Dataset>()> read) {
  const auto pages = static_cast<rlim_t>(sysconf(_SC_PHYS_PAGES));
  const auto page = static_cast<rlim_t>(sysconf(_SC_PAGESIZE));
  Limit(RLIMIT_CORE, 0);
  Limit(RLIMIT_CPU, kMostSeconds);
  Limit(RLIMIT_DATA, DataBytes() + pages / 2 * page);
  // Ends without destructors and buffers, which belong to the parent.
  _exit(WriteResult(fd, ReadOrCatch(read)) ? 0 : 1);
}

absl::Status Errno(absl::string_view what) {
  return absl::ResourceExhaustedError(absl::StrCat(what, ": ", std::strerror(errno)));
}

absl::StatusOr<std::string> ReadBack(int fd) {
  std::string bytes(static_cast<size_t>(lseek(fd, 0, SEEK_END)), '\0');
  size_t read = 0;
  while (read < bytes.size()) {
    const ssize_t more =
        pread(fd, bytes.data() + read, bytes.size() - read, static_cast<off_t>(read));
    if (more < 0 && errno == EINTR) continue;
    if (more <= 0) return Errno("reading what the child process has read");
    read += static_cast<size_t>(more);
  }
  return bytes;
}

absl::StatusOr<Dataset> Result(int fd, int state) {
  if (!WIFEXITED(state) || WEXITSTATUS(state) != 0) {
    const std::string end = WIFSIGNALED(state) ? absl::StrCat("signal ", WTERMSIG(state), ", ",
                                                              strsignal(WTERMSIG(state)))
                                               : absl::StrCat("exit status ", WEXITSTATUS(state));
    return absl::InvalidArgumentError(absl::StrCat(
        "expected data that the HDF5 library can read, received some that ended the process which "
        "read it (",
        end, ")"));
  }
  ASSIGN_OR_RETURN(const auto bytes, ReadBack(fd));
  if (bytes.empty()) return absl::InternalError("expected a result, received none");
  const auto code = static_cast<absl::StatusCode>(bytes[0]);
  const absl::string_view rest = absl::string_view(bytes).substr(1);
  if (code != absl::StatusCode::kOk) return absl::Status(code, rest);
  return ParseDataset(rest);
}

}  // namespace

absl::StatusOr<Dataset> ReadInChild(absl::FunctionRef<absl::StatusOr<Dataset>()> read) {
  const int fd = memfd_create("dataset", MFD_CLOEXEC);
  if (fd < 0) return Errno("memfd_create");
  const pid_t child = fork();
  if (child == 0) RunChild(fd, read);
  absl::StatusOr<Dataset> dataset = absl::UnknownError("");
  if (child < 0) {
    dataset = Errno("fork");
  } else {
    int state = 0;
    while (waitpid(child, &state, 0) < 0 && errno == EINTR) {
    }
    dataset = Result(fd, state);
  }
  close(fd);
  return dataset;
}

}  // namespace spikeserve
