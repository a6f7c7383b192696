#include "server/agent/request_order.h"

#include <cstdint>
#include <optional>

namespace spikeserve {
namespace {

// Where a request belongs, as far as it says so.
struct Place {
  std::optional<int64_t> episode;
  std::optional<uint64_t> decision;  // decisions of the session before the request
  int64_t step = 0;                  // decisions of the episode before the request
};

// Orders by episode, decision and step. The end of an episode changes no number of decisions, but
// the step after it is a smaller one.
bool IsAfter(const Place& place, const Session& session) {
  if (place.episode.has_value() && *place.episode != session.episode) {
    return *place.episode > session.episode;
  }
  if (!place.decision.has_value()) return place.step > session.step;
  if (*place.decision != session.decisions) return *place.decision > session.decisions;
  return place.step < session.step;
}

}  // namespace

bool IsAhead(const v1::ActRequest& request, const Session& session) {
  Place place = {.episode = std::nullopt, .decision = std::nullopt, .step = request.step()};
  if (request.has_decision()) place.decision = request.decision();
  return IsAfter(place, session);
}

bool IsAhead(const v1::EndEpisodeRequest& request, const Session& session) {
  Place place = {.episode = std::nullopt, .decision = std::nullopt, .step = request.steps()};
  if (request.has_episode()) place.episode = request.episode();
  return IsAfter(place, session);
}

bool NamesPlace(const v1::ActRequest& request) { return request.has_decision(); }

bool NamesPlace(const v1::EndEpisodeRequest& request) {
  return request.has_episode() && request.has_steps();
}

}  // namespace spikeserve
