#include "server/agent/request_order.h"

namespace spikeserve {

Place PlaceOf(const v1::ActRequest& request) {
  Place place = {.step = request.step(), .is_of_session = request.has_decision()};
  if (request.has_decision()) place.decision = request.decision();
  if (request.has_end_episode()) place.episode = request.end_episode().episode();
  return place;
}

Place PlaceOf(const v1::EndEpisodeRequest& request) {
  Place place = {.step = request.steps(),
                 .is_of_session = request.has_episode() && request.has_steps()};
  if (request.has_episode()) place.episode = request.episode();
  return place;
}

// Orders by episode, decision and step. The end of an episode changes no number of decisions, but
// the step after it is a smaller one.
bool IsAhead(const Place& place, const Session& session) {
  if (place.episode.has_value() && *place.episode != session.episode) {
    return *place.episode > session.episode;
  }
  if (!place.decision.has_value()) return place.step > session.step;
  if (*place.decision != session.decisions) return *place.decision > session.decisions;
  return place.step < session.step;
}

}  // namespace spikeserve
