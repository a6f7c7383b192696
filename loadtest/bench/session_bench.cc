// Measures the memory of a policy with its engine, and of a session: opened, active, and idle.
// Prints one JSON object.
//
// The figures are bytes allocated on the heap, of sessions divided by their number. They include
// the store's table and the list of ids that this program keeps, and freed memory that the
// allocator keeps for the thread, unless GLIBC_TUNABLES=glibc.malloc.tcache_count=0 is set.
// `resident_bytes` is the resident memory of the whole process at the end.
//
// Active sessions use the engine of the policy. An idle session keeps no state of its engine. With
// more than --active sessions, only idle ones are measured, and an engine that does not compute
// fills their histories, so that a million of them are ready within seconds.

#include <malloc.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <fstream>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "core/open_sessions/session_store.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

struct Flags {
  std::string policy;
  int64_t sessions = 1000;
  int64_t active = 1000;
};

// Ignores all events.
class SilentEngine final : public Engine {
 public:
  explicit SilentEngine(std::shared_ptr<const Policy> policy) : policy_(std::move(policy)) {}

  const Policy& policy() const override { return *policy_; }
  std::unique_ptr<Context> NewContext(int64_t) const override {
    return std::make_unique<Context>();
  }
  void Decide(Context&, float, absl::Span<const float>, Output* output) const override {
    output->readout.assign(static_cast<size_t>(policy_->config.hidden_size), 0.0f);
  }
  void AppendAction(Context&, absl::Span<const float>) const override {}

 private:
  std::shared_ptr<const Policy> policy_;
};

std::shared_ptr<const ServedPolicy> Serve(std::shared_ptr<const Engine> engine) {
  auto served = std::make_shared<ServedPolicy>();
  served->name = "cartpole";
  served->version = 1;
  served->engine = std::move(engine);
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

int64_t AllocatedBytes() {
  const struct mallinfo2 info = mallinfo2();
  return static_cast<int64_t>(info.uordblks + info.hblkhd);
}

int64_t ResidentBytes() {
  int64_t total = 0, resident = 0;
  std::ifstream("/proc/self/statm") >> total >> resident;
  return resident * sysconf(_SC_PAGESIZE);
}

// Opens sessions, plays them and compacts them, and measures their memory. Not thread-safe.
class Measurement {
 public:
  Measurement(int64_t sessions, std::shared_ptr<const ServedPolicy> served)
      : sessions_(sessions), served_(std::move(served)), before_(AllocatedBytes()) {
    store_ = std::make_unique<SessionStore>(sessions, &clock_);
    ids_.reserve(static_cast<size_t>(sessions));
  }

  // Opens the sessions and returns the bytes per session.
  int64_t Opened() {
    SessionOptions options;
    options.policy = served_->name;
    options.version = served_->version;
    options.target_return = 500.0;
    for (int64_t i = 0; i < sessions_; ++i) ids_.push_back(*store_->Open(served_, options));
    return BytesPerSession();
  }

  // Plays every session for one timestep more than its history holds.
  void Play() {
    const int steps = HistorySize(served_->policy().config) + 1;
    const std::vector<float> observation(static_cast<size_t>(served_->policy().observation_size()));
    for (const std::string& id : ids_) PlaySession(id, steps, observation);
  }

  void Compact() { store_->CompactIdle(absl::ZeroDuration()); }

  int64_t BytesPerSession() const { return (AllocatedBytes() - before_) / sessions_; }

 private:
  void PlaySession(const std::string& id, int steps, const std::vector<float>& observation) {
    const auto entry = *store_->Find(id);
    absl::MutexLock lock(&entry->mutex);
    for (int step = 0; step < steps; ++step) (void)entry->agent.Act(step, observation, 1.0);
    entry->agent.AppendPendingAction();
  }

  const int64_t sessions_;
  const std::shared_ptr<const ServedPolicy> served_;
  const int64_t before_;
  const SteadyClock clock_;
  std::unique_ptr<SessionStore> store_;
  std::vector<std::string> ids_;
};

absl::Status Run(const Flags& flags) {
  const int64_t before = AllocatedBytes();
  ASSIGN_OR_RETURN(auto policy, ReadPolicyFile(flags.policy));
  const std::shared_ptr<const Engine> engine = MakeEngine(std::move(policy));
  const std::shared_ptr<const Policy> shared(engine, &engine->policy());
  const int64_t sessions = flags.sessions;
  const bool can_be_active = sessions <= flags.active;
  nlohmann::ordered_json result = {{"policy_bytes", AllocatedBytes() - before},
                                   {"sessions", sessions}};
  Measurement measurement(
      sessions, can_be_active ? Serve(engine) : Serve(std::make_shared<SilentEngine>(shared)));
  result["opened_bytes"] = measurement.Opened();
  measurement.Play();
  if (can_be_active) result["active_bytes"] = measurement.BytesPerSession();
  measurement.Compact();
  result["idle_bytes"] = measurement.BytesPerSession();
  result["resident_bytes"] = ResidentBytes();
  std::cout << result.dump() << std::endl;
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::Flags flags;
  CLI::App app("Measures the memory of a session", "session_bench");
  app.add_option("--policy", flags.policy, "Policy file")->required();
  app.add_option("--sessions", flags.sessions, "Sessions open at once");
  app.add_option("--active", flags.active, "Most sessions that are active at once");
  CLI11_PARSE(app, argc, argv);
  const absl::Status status = spikeserve::Run(flags);
  if (status.ok()) return 0;
  std::cerr << "session_bench: " << status.message() << std::endl;
  return 1;
}
