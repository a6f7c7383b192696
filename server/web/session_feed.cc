#include "server/web/session_feed.h"

#include <optional>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/time/time.h"
#include "core/session/session_id.h"
#include "proto/json.h"
#include "server/base/method.h"
#include "server/messages/explain_convert.h"
#include "server/web/status_json.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kExplainInterval = absl::Milliseconds(250);
constexpr absl::Duration kPingInterval = absl::Seconds(10);  // shorter than proxies wait

// A line that a browser ignores, which finds out whether it is still there.
constexpr absl::string_view kPing = ":\n\n";

std::string Event(absl::string_view name, absl::string_view json) {
  return absl::StrCat("event: ", name, "\ndata: ", json, "\n\n");
}

std::string ToEvent(absl::string_view name, const v1::ExplainResponse& decision) {
  return Event(name, JsonText(MessageToFields(decision)));
}

// What a feed saw of a session.
struct Glance {
  uint64_t decisions = 0;
  v1::ExplainResponse decision;  // the last one
};

// Returns the last decision of a session if it is not number `seen`. Returns nullopt while a
// request holds the session, and before the first decision of an episode.
std::optional<Glance> TryGlance(SessionEntry& entry, uint64_t seen) {
  if (!entry.mutex.TryLock()) return std::nullopt;
  std::optional<Glance> glance;
  const Session& session = entry.agent.session();
  if (session.decisions != seen && session.last_answer.has_value()) {
    glance = {.decisions = session.decisions, .decision = DecisionToProto(*entry.served, session)};
  }
  entry.mutex.Unlock();
  return glance;
}

// Hands an explanation from the worker to the feed. Thread-safe.
class Mailbox {
 public:
  void Put(std::string event) {
    absl::MutexLock lock(&mutex_);
    event_ = std::move(event);
  }
  // Returns what was put since the last call, or nullopt.
  std::optional<std::string> Take() {
    absl::MutexLock lock(&mutex_);
    return std::exchange(event_, std::nullopt);
  }

 private:
  absl::Mutex mutex_;
  std::optional<std::string> event_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace

// Confined to the thread of the loop that asks it, except for its destructor.
class SessionFeeds::Feed final : public HttpFeed {
 public:
  Feed(const Parts& parts, std::shared_ptr<SharedPlaces::Place> place,
       std::shared_ptr<Clients> clients, std::shared_ptr<const Credential> caller,
       std::string client, std::string session)
      : parts_(parts),
        place_(std::move(place)),
        clients_(std::move(clients)),
        caller_(std::move(caller)),
        client_(std::move(client)),
        session_(std::move(session)) {}

  ~Feed() override {
    absl::MutexLock lock(&clients_->mutex);
    if (--clients_->feeds[client_] == 0) clients_->feeds.erase(client_);
  }

  std::optional<std::string> Next() override {
    if (ended_) return std::nullopt;
    const absl::Duration now = parts_.clock->Now();
    if (auto status = caller_->CheckValid(); !status.ok()) return End(status);
    const std::shared_ptr<SessionEntry> entry =
        parts_.store->Peek(session_, caller_->tenant()->name());
    if (entry == nullptr || !caller_->CanRead(entry->tenant)) return End(NoSuchSession(session_));
    std::string events;
    if (auto glance = TryGlance(*entry, seen_); glance.has_value()) {
      seen_ = glance->decisions;
      events = ToEvent("decision", glance->decision);
    }
    if (auto explained = explanations_->Take(); explained.has_value()) {
      explaining_ = false;
      events += *explained;
    }
    if (seen_ != explained_ && !explaining_ && now >= explain_after_) Explain(now);
    if (!events.empty()) {
      sent_ = now;
    } else if (now - sent_ >= kPingInterval) {
      sent_ = now;
      events = std::string(kPing);
    }
    return events;
  }

 private:
  std::string End(const absl::Status& status) {
    ended_ = true;
    return Event("end", ErrorJson(status));
  }

  // Has the last decision explained, if the tenant and the worker have room. Otherwise a later
  // turn tries again.
  void Explain(absl::Duration now) {
    explain_after_ = now + kExplainInterval;
    if (!caller_->tenant()->AcquireCall(Cost::kExplain, now).ok()) return;
    const auto work = [store = parts_.store, id = session_, tenant = caller_->tenant()->name(),
                       mailbox = std::weak_ptr<Mailbox>(explanations_)] {
      const auto wanted = mailbox.lock();
      if (wanted == nullptr) return;  // the client has left
      v1::ExplainResponse response;
      const auto entry = store->Peek(id, tenant);
      const bool explained = entry != nullptr && ExplainSession(*entry, &response).ok();
      wanted->Put(explained ? ToEvent("explanation", response) : "");
    };
    if (!parts_.worker->Submit(caller_->tenant()->name(), work).ok()) return;
    explaining_ = true;
    explained_ = seen_;
  }

  const Parts parts_;
  const std::shared_ptr<SharedPlaces::Place> place_;
  const std::shared_ptr<Clients> clients_;
  const std::shared_ptr<const Credential> caller_;
  const std::string client_;
  const std::string session_;
  const std::shared_ptr<Mailbox> explanations_ = std::make_shared<Mailbox>();
  uint64_t seen_ = 0;        // number of the decision that was sent last
  uint64_t explained_ = 0;   // of the one whose explanation was asked for last
  bool explaining_ = false;  // the worker explains
  bool ended_ = false;
  absl::Duration explain_after_ = absl::ZeroDuration();  // times of the clock
  absl::Duration sent_ = absl::ZeroDuration();
};

absl::StatusOr<std::shared_ptr<HttpFeed>> SessionFeeds::Open(
    std::shared_ptr<const Credential> caller, const std::string& client,
    const std::string& session) {
  const std::shared_ptr<SessionEntry> entry = parts_.store->Peek(session, caller->tenant()->name());
  if (entry == nullptr || !caller->CanRead(entry->tenant)) return NoSuchSession(session);
  auto place = places_.Take(caller->tenant()->name());
  {
    absl::MutexLock lock(&clients_->mutex);
    const auto of_client = clients_->feeds.find(client);
    if (place == nullptr ||
        (of_client != clients_->feeds.end() && of_client->second >= kMostOfClient)) {
      return absl::ResourceExhaustedError(absl::StrCat("watchers of sessions: expected at most ",
                                                       kMostOfTenant, ", and ", kMostOfClient,
                                                       " of one address; try again later"));
    }
    ++clients_->feeds[client];
  }
  return std::make_shared<Feed>(parts_, std::move(place), clients_, std::move(caller), client,
                                session);
}

}  // namespace spikeserve
