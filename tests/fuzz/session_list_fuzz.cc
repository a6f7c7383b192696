// Queries of the list of sessions: every one is refused with a reason, or its pages list each
// matching session once.
//
// An input is the query of an URL after `?`, already decoded.
#include <map>
#include <set>

#include "absl/strings/str_split.h"
#include "nlohmann/json.hpp"
#include "server/web/session_list.h"
#include "tests/fuzz/fuzzed_server.h"

namespace spikeserve {
namespace {

constexpr int kSessions = 5;

FuzzedServer& ServerWithSessions() {
  static auto* const server = [] {
    auto* made = new FuzzedServer;  // lives as long as the process
    for (int i = 0; i < kSessions; ++i) {
      v1::OpenSessionRequest request;
      request.set_policy("small");
      (*request.mutable_labels())["robot"] = std::string(1, static_cast<char>('a' + i));
      v1::OpenSessionResponse opened;
      DeferredWork deferred;
      CallContext context = made->NewContext(&deferred);
      FUZZ_CHECK(made->handler().OpenSession(context, request, &opened).ok());
      for (int step = 0; step < i; ++step) {
        v1::ActRequest act;
        act.set_session_id(opened.session_id());
        act.set_step(step);
        for (const float value : ObservationAt(step)) act.add_observation(value);
        v1::ActResponse response;
        FUZZ_CHECK(made->handler().Act(context, act, &response).ok());
      }
    }
    return made;
  }();
  return *server;
}

}  // namespace

void FuzzOne(absl::string_view input) {
  std::multimap<std::string, std::string> parameters;
  for (const absl::string_view part : absl::StrSplit(input, '&')) {
    const std::pair<std::string, std::string> parameter =
        absl::StrSplit(part, absl::MaxSplits('=', 1));
    parameters.insert(parameter);
  }
  FuzzedServer& server = ServerWithSessions();
  std::set<std::string> seen;
  const bool from_the_start = parameters.count("page_token") == 0;
  for (int page = 0; page <= kSessions; ++page) {
    const auto query =
        HttpQuery::Parse(parameters, {"filter", "sort", "order", "page_size", "page_token"});
    if (!query.ok()) return FUZZ_CHECK(!query.status().message().empty());
    const auto list = SessionsJson(server.store(), server.caller(), *query);
    if (!list.ok()) return FUZZ_CHECK(page == 0 && !list.status().message().empty());
    const auto json = nlohmann::json::parse(*list, nullptr, /*allow_exceptions=*/false);
    FUZZ_CHECK(json["open"] == kSessions);
    for (const auto& session : json["sessions"]) {
      FUZZ_CHECK(seen.insert(session["session_id"]).second);
    }
    const std::string next = json["next_page_token"];
    if (next.empty()) {
      if (from_the_start) FUZZ_CHECK(json["matching"] == seen.size());
      return;
    }
    parameters.erase("page_token");
    parameters.insert({"page_token", next});
  }
  FUZZ_CHECK(false);  // more pages than sessions
}

std::vector<std::string> Seeds() {
  return {"sort=steps&order=descending&page_size=2",
          "sort=decisions&order=descending&page_size=2",
          "filter=robot=c&sort=policy",
          "sort=mean_return&page_size=1&filter=small/1",
          "page_token=hmdzdGVwAAABYQ",
          "page_token=myAAAAAAAAAA"};
}

}  // namespace spikeserve
