// Streams the decisions of a session to the status page, as server-sent events.
//
//   SessionFeeds feeds({...});
//   auto feed = feeds.Open(caller, "10.0.0.7", session_id);
//   done({.content_type = "text/event-stream", .feed = *std::move(feed)});
//
// The events are:
//   decision     an ExplainResponse as JSON, without spikes, attention and gates: the last
//   decision,
//                at most one every 50 ms; decisions in between are left out
//   explanation  an ExplainResponse as JSON with everything, at most one every 250 ms; it takes its
//                turn among the calls of Explain and counts against the tenant's limit of them
//   end          {"code", "message"}: the session has ended, or the caller may not see it any more
//
// A feed looks at the session when the loop asks it to. Therefore a session that nobody watches
// costs nothing, a decision does no work for a watched one, and watching does not keep a session.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>

#include "absl/base/thread_annotations.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "core/base/clock.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/base/background_worker.h"
#include "server/base/shared_places.h"
#include "server/web/http_message.h"

namespace spikeserve {

// Opens feeds, and bounds how many are open. Thread-safe. The feeds may outlive this object, but
// not the objects of `Parts` while they are asked for bytes.
class SessionFeeds {
 public:
  static constexpr int64_t kMostOfTenant = 16;  // open feeds; see SharedPlaces
  static constexpr int64_t kMostOfClient = 4;   // of one IP address

  struct Parts {
    SessionStore* store;
    const Clock* clock;
    BackgroundWorker* worker;  // explains
  };

  explicit SessionFeeds(Parts parts)
      : parts_(parts), places_(2 * kMostOfTenant), clients_(std::make_shared<Clients>()) {}

  // Opens a feed of a session that `caller` may read. Returns NOT_FOUND if there is none, and
  // RESOURCE_EXHAUSTED if as many feeds are open as may be.
  absl::StatusOr<std::shared_ptr<HttpFeed>> Open(std::shared_ptr<const Credential> caller,
                                                 const std::string& client,
                                                 const std::string& session);

 private:
  class Feed;
  // The open feeds, by the address of the client. Shared with them.
  struct Clients {
    absl::Mutex mutex;
    std::map<std::string, int64_t> feeds ABSL_GUARDED_BY(mutex);
  };

  const Parts parts_;
  SharedPlaces places_;  // of tenants
  const std::shared_ptr<Clients> clients_;
};

}  // namespace spikeserve
