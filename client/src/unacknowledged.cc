#include "spikeserve/unacknowledged.h"

#include <algorithm>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "spikeserve/client.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

// Returns the bytes of an answer without what may differ between servers and attempts.
std::string Comparable(v1::ActResponse answer) {
  answer.mutable_stats()->clear_compute_seconds();
  answer.clear_durable_decision();
  answer.clear_durable_episode();
  answer.clear_next_step();
  answer.clear_appended();
  answer.clear_dropped();
  answer.clear_queue_seconds();
  answer.clear_append_seconds();
  return answer.SerializeAsString();
}

std::string Comparable(v1::EndEpisodeResponse answer) {
  answer.clear_recording();
  return answer.SerializeAsString();
}

template <typename Message>
Message Parsed(const std::string& bytes) {
  Message message;
  message.ParseFromString(bytes);  // that SerializeAsString() has returned
  return message;
}

// Replaces the answer to a request of `session_id` by `answer`. Returns DATA_LOSS if they differ.
template <typename Answer>
absl::Status Take(const Answer& answer, const std::string& session_id, uint64_t decision,
                  std::string* kept) {
  const auto before = Parsed<Answer>(*kept);
  bool is_equal = Comparable(before) == Comparable(answer);
  if constexpr (std::is_same_v<Answer, v1::ActResponse>) {
    // A hold, or an operator, may have come or gone meanwhile.
    is_equal = is_equal || before.has_source() || answer.has_source();
  }
  *kept = answer.SerializeAsString();
  return is_equal ? absl::OkStatus() : DivergedError(session_id, decision);
}

// Returns whether the call that follows shows what is still missing after `error`. If this server
// does not know the session, that call asks the others, too.
bool IsSaidAgain(const absl::Status& error) {
  return IsRetryable(error) || absl::IsNotFound(error) || ExpectedDecision(error).has_value();
}

}  // namespace

void Unacknowledged::Add(uint64_t decision, const v1::ActRequest& request,
                         const v1::ActResponse& answer) {
  Add({decision, /*is_act=*/true, request.SerializeAsString(), answer.SerializeAsString()});
}

void Unacknowledged::Add(uint64_t decision, const v1::EndEpisodeRequest& request,
                         const v1::EndEpisodeResponse& answer) {
  Add({decision, /*is_act=*/false, request.SerializeAsString(), answer.SerializeAsString()});
}

void Unacknowledged::Add(Answered answered) {
  const uint64_t decision = answered.decision;
  answered_.push_back(std::move(answered));
  while (answered_.front().decision + kMostDecisions <= decision) answered_.pop_front();
}

bool Unacknowledged::Covers(uint64_t decision) const {
  return !answered_.empty() && answered_.front().decision <= decision &&
         answered_.back().decision >= decision;
}

absl::Status Unacknowledged::SendAgain(uint64_t decision, Client* client,
                                       const std::shared_ptr<Route>& route) {
  const auto is_act = [](const Answered& answered) { return answered.is_act; };
  auto next = std::find_if(answered_.begin(), answered_.end(),
                           [&](const Answered& a) { return a.decision >= decision; });
  while (next != answered_.end()) {
    absl::Status status;
    if (next->is_act) {
      const auto end = std::find_if_not(next, answered_.end(), is_act);
      status = ActAgain(next, end, client, route);
      next = end;
    } else {
      const auto request = Parsed<v1::EndEpisodeRequest>(next->request);
      const auto answer = client->EndEpisode(request, route);
      status = answer.ok() ? Take(*answer, request.session_id(), next->decision, &next->answer)
                           : answer.status();
      ++next;
    }
    if (IsSaidAgain(status)) return absl::OkStatus();
    if (!status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::Status Unacknowledged::SendLastAgain(Client* client, const std::shared_ptr<Route>& route) {
  return SendAgain(answered_.back().decision, client, route);
}

absl::Status Unacknowledged::ActAgain(Iterator begin, Iterator end, Client* client,
                                      const std::shared_ptr<Route>& route) {
  std::vector<v1::ActRequest> requests;
  for (auto i = begin; i != end; ++i) requests.push_back(Parsed<v1::ActRequest>(i->request));
  auto results = client->ActBatch(requests, route);
  if (!results.ok()) return results.status();
  absl::Status diverged;
  for (size_t i = 0; i < results->size(); ++i, ++begin) {
    const auto& result = (*results)[i];
    if (!result.ok()) return diverged.ok() ? result.status() : diverged;
    diverged.Update(Take(*result, requests[i].session_id(), begin->decision, &begin->answer));
  }
  return diverged;
}

}  // namespace spikeserve
