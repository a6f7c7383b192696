// The last requests of a session, which its next server may miss. RemoteSession uses it.
//
// A server answers a session of durability ASYNC before the store has the decision, and a store may
// lose what it has acknowledged: Redis, when a copy takes its place that is behind. The next server
// then expects an older decision. These requests are sent again, in order, and get the same
// answers, because a decision depends only on the requests of its session.
//
// Not thread-safe.
#ifndef SPIKESERVE_UNACKNOWLEDGED_H_
#define SPIKESERVE_UNACKNOWLEDGED_H_

#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

class Client;
struct Route;

class Unacknowledged {
 public:
  // The most decisions of one session that a server lets wait for the store, and that are kept.
  static constexpr uint64_t kMostDecisions = 256;

  // Adds an answered request. `decision` is the number of the decision, or of the one that follows
  // the end of an episode. Keeps at most kMostDecisions.
  void Add(uint64_t decision, const v1::ActRequest& request, const v1::ActResponse& answer);
  void Add(uint64_t decision, const v1::EndEpisodeRequest& request,
           const v1::EndEpisodeResponse& answer);

  size_t size() const { return answered_.size(); }
  // Returns whether all requests from `decision` on are here, and at least one.
  bool Covers(uint64_t decision) const;

  // Sends all requests from `decision` on again, in order. Returns DATA_LOSS (DivergedAt) if one of
  // them gets another answer than before; the new answers count from then on. Returns OK if a
  // server cannot answer now: the call that follows shows what is still missing.
  absl::Status SendAgain(uint64_t decision, Client* client, const std::shared_ptr<Route>& route);
  // Sends the last request again. A server whose copy of the session is an old one claims the
  // session for it. REQUIRES: size() > 0.
  absl::Status SendLastAgain(Client* client, const std::shared_ptr<Route>& route);

 private:
  // Serialized, because a message takes several times as much memory.
  struct Answered {
    uint64_t decision;
    bool is_act;  // otherwise an EndEpisode
    std::string request;
    std::string answer;
  };
  using Iterator = std::deque<Answered>::iterator;

  void Add(Answered answered);
  // Sends the acts in [begin, end) again with one call.
  absl::Status ActAgain(Iterator begin, Iterator end, Client* client,
                        const std::shared_ptr<Route>& route);

  std::deque<Answered> answered_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_UNACKNOWLEDGED_H_
