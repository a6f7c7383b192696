// Datasets in Minari's layout: every file is refused with a reason, or gives valid episodes.
//
// The first byte of an input selects what the others are: 0 the metadata, which is parsed in this
// process, 1 the HDF5 file, which is read in a child process, because the HDF5 library crashes for
// some files. A signal that ends the child is such a crash. A report of a sanitizer is a finding,
// unless the library alone is to blame: it ends the child with an exit status. Arrays that do not
// fit into memory are no finding: in production they are refused.
#include <pthread.h>
#include <unistd.h>

#include <csignal>
#include <filesystem>
#include <fstream>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/file.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/support/read_minari.h"
#include "train/data/minari_layout.h"
#include "train/data/minari_metadata.h"
#include "train/data/minari_writer.h"

// Functions of the address sanitizer; the first two are null without it. The sanitizer calls the
// third one before it reports an error.
extern "C" __attribute__((weak)) const char* __asan_get_report_description();
extern "C" __attribute__((weak)) void __asan_set_error_report_callback(void (*)(const char*));
extern "C" void __asan_on_error();

namespace spikeserve {
namespace {

bool is_child = false;

Dataset Small() {
  Episode episode = {
      .actor = "expert",
      .seed = 3,
      .observations = {0.1f, 0.2f, 0.3f, 0.4f, 0.5f, 0.6f},
      .actions = {{.discrete = 1, .continuous = {}}, {.discrete = 0, .continuous = {}}},
      .weights = {0.5f, 1.0f},
      .rewards = {1.0, 0.5},
      .terminated = true};
  return {.environment = "CartPole-v1",
          .observation_size = 2,
          .action_space = ActionSpace::Discrete(2),
          .episodes = {episode}};
}

// A dataset on disk, of which inputs replace the HDF5 file. Lives as long as the process.
struct Folder {
  Folder()
      : path((std::filesystem::temp_directory_path() / absl::StrCat("fuzz-", getpid()) / "fuzz-v0")
                 .string()) {
    FUZZ_CHECK(WriteMinariDataset(Small(), path).ok());
    metadata = *ReadFile(path + kMinariMetadata);
    data = *ReadFile(path + kMinariData);
  }
  ~Folder() { std::filesystem::remove_all(std::filesystem::path(path).parent_path()); }

  const std::string path;
  std::string metadata;
  std::string data;
};

const Folder& SmallFolder() {
  static const Folder folder;
  return folder;
}

// Ends a child process as a crash if the HDF5 library made the error that the sanitizer reports, in
// memory of its own. Frame 0 of a stack is the sanitizer's function, such as memcpy or calloc, as
// the library itself is not instrumented.
void TakeReport(const char* report) {
  if (!is_child) return;
  for (const absl::string_view line : absl::StrSplit(report, '\n')) {
    if (absl::StartsWith(line, "    #1 ") && !absl::StrContains(line, "libhdf5")) return;
  }
  std::abort();
}

// In a child process, signals end the process as they do in production. Without this, libFuzzer and
// the sanitizers handle them, and end the process with an exit status.
void LetSignalsEndChildren() {
  if (__asan_set_error_report_callback != nullptr) __asan_set_error_report_callback(TakeReport);
  pthread_atfork(nullptr, nullptr, [] {
    is_child = true;
    for (const int number : {SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV})
      std::signal(number, SIG_DFL);
  });
}

void CheckDataset(const absl::StatusOr<Dataset>& dataset) {
  if (!dataset.ok()) {
    const absl::string_view message = dataset.status().message();
    FUZZ_CHECK(!message.empty());
    // libFuzzer ends a process with status 71 that takes too much memory.
    const bool in_order = !absl::StrContains(message, "(exit status");
    return FUZZ_CHECK(in_order || absl::StrContains(message, "(exit status 71)"));
  }
  for (const Episode& episode : dataset->episodes) FUZZ_CHECK(CheckEpisode(*dataset, episode).ok());
}

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  const bool is_data = reader.Byte() % 2 == 1;
  if (!is_data) {
    const auto metadata = ParseMinariMetadata(reader.rest());
    if (!metadata.ok()) return FUZZ_CHECK(!metadata.status().message().empty());
    FUZZ_CHECK(metadata->dataset.observation_size > 0);
    FUZZ_CHECK(metadata->dataset.action_space.Validate().ok());
    FUZZ_CHECK(metadata->indices.counts.size() == metadata->indices.starts.size());
    return;
  }
  const Folder& folder = SmallFolder();
  [[maybe_unused]] static const bool signals_end_children = (LetSignalsEndChildren(), true);
  std::ofstream(folder.path + kMinariData, std::ios::binary) << reader.rest();
  CheckDataset(ReadMinariDataset(folder.path));
}

std::vector<std::string> Seeds() {
  const Folder& folder = SmallFolder();
  return {
      absl::StrCat(std::string(1, '\0'), folder.metadata),
      absl::StrCat(
          std::string(1, '\0'),
          R"({"dataset_id": "a/b-v0", "total_episodes": 1, "env_spec": "{\"id\": \"E-v1\"}",
 "observation_space": "{\"type\": \"Box\", \"shape\": [2, 3], \"low\": -Infinity, \"high\": 1}",
 "action_space": "{\"type\": \"MultiDiscrete\", \"nvec\": [2, 3], \"start\": [0, -1]}"})"),
      absl::StrCat("\x01", folder.data),
  };
}

}  // namespace spikeserve

extern "C" void __asan_on_error() {
  if (!spikeserve::is_child || __asan_get_report_description == nullptr) return;
  const absl::string_view error = __asan_get_report_description();
  if (error == "out-of-memory" || error == "allocation-size-too-big") std::abort();
}
