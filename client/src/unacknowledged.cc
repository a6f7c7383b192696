#include "spikeserve/unacknowledged.h"

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "spikeserve/client.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

// The most decisions of one session that a server lets wait for the store.
constexpr uint64_t kMostDecisions = 256;

// Returns the bytes of an answer without what may differ between servers and attempts.
std::string Comparable(v1::ActResponse answer) {
  answer.mutable_stats()->clear_compute_seconds();
  answer.clear_durable_decision();
  return answer.SerializeAsString();
}

std::string Comparable(v1::EndEpisodeResponse answer) {
  answer.clear_recording();
  return answer.SerializeAsString();
}

// Replaces the answer of `exchange` by `answer`. Returns DATA_LOSS if they differ.
template <typename Exchange, typename Answer>
absl::Status Take(Answer answer, uint64_t decision, Exchange* exchange) {
  const bool is_equal = Comparable(exchange->answer) == Comparable(answer);
  exchange->answer = std::move(answer);
  if (is_equal) return absl::OkStatus();
  return DivergedError(exchange->request.session_id(), decision);
}

// Returns whether the call that follows says what is still missing after `error`.
bool IsSaidAgain(const absl::Status& error) {
  return IsRetryable(error) || ExpectedDecision(error).has_value();
}

}  // namespace

void Unacknowledged::Add(uint64_t decision, v1::ActRequest request, v1::ActResponse answer) {
  const uint64_t durable = answer.durable_decision();
  answered_.push_back({decision, Act{std::move(request), std::move(answer)}});
  const uint64_t oldest = decision + 1 > kMostDecisions ? decision + 1 - kMostDecisions : 0;
  const uint64_t first = std::max(durable, oldest);
  while (answered_.size() > 1 && answered_.front().decision < first) answered_.pop_front();
}

void Unacknowledged::Add(uint64_t decision, v1::EndEpisodeRequest request,
                         v1::EndEpisodeResponse answer) {
  answered_.push_back({decision, End{std::move(request), std::move(answer)}});
}

bool Unacknowledged::Covers(uint64_t decision) const {
  return !answered_.empty() && answered_.front().decision <= decision &&
         answered_.back().decision >= decision;
}

absl::Status Unacknowledged::SendAgain(uint64_t decision, Client* client,
                                       const std::shared_ptr<Route>& route) {
  const auto is_act = [](const Answered& answered) { return answered.exchange.index() == 0; };
  auto next = std::find_if(answered_.begin(), answered_.end(),
                           [&](const Answered& a) { return a.decision >= decision; });
  while (next != answered_.end()) {
    absl::Status status;
    if (is_act(*next)) {
      const auto end = std::find_if_not(next, answered_.end(), is_act);
      status = ActAgain(next, end, client, route);
      next = end;
    } else {
      End& ending = std::get<End>(next->exchange);
      auto answer = client->EndEpisode(ending.request, route);
      status = answer.ok() ? Take(*std::move(answer), next->decision, &ending) : answer.status();
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
  for (auto i = begin; i != end; ++i) requests.push_back(std::get<Act>(i->exchange).request);
  auto results = client->ActBatch(requests, route);
  if (!results.ok()) return results.status();
  absl::Status diverged;
  for (auto& result : *results) {
    if (!result.ok()) return diverged.ok() ? result.status() : diverged;
    diverged.Update(Take(*std::move(result), begin->decision, &std::get<Act>(begin->exchange)));
    ++begin;
  }
  return diverged;
}

}  // namespace spikeserve
