// Tests of a real server's status page and of the JSON documents that the page reads.
#include <set>
#include <string>
#include <vector>

#include "nlohmann/json.hpp"
#include "tests/integration/http_client.h"
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

using nlohmann::json;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

class StatusPagesTest : public ServerTest {
 protected:
  HttpReply Get(const std::string& path) {
    const auto reply = HttpGet(server_->http_address(), path);
    EXPECT_TRUE(reply.ok()) << reply.status();
    return reply.ok() ? *reply : HttpReply();
  }

  // Returns the JSON document at `path`. Fails the test unless the HTTP code is `code`.
  json GetJson(const std::string& path, int code = 200) {
    const HttpReply reply = Get(path);
    EXPECT_EQ(reply.code, code) << path << ": " << reply.body;
    EXPECT_THAT(reply.headers, HasSubstr("Content-Type: application/json"));
    json parsed = json::parse(reply.body, nullptr, /*allow_exceptions=*/false);
    EXPECT_TRUE(parsed.is_object()) << reply.body;
    return parsed;
  }

  // Opens a session, makes `steps` decisions and returns the session's id.
  std::string Play(const std::string& policy, int64_t steps,
                   const std::map<std::string, std::string>& labels = {}) {
    v1::OpenSessionRequest request;
    request.set_policy(policy);
    request.mutable_labels()->insert(labels.begin(), labels.end());
    v1::OpenSessionResponse response;
    EXPECT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &response).ok());
    for (int64_t step = 0; step < steps; ++step) client_->Act(response.session_id(), step);
    return response.session_id();
  }

  std::vector<std::string> SessionIds(const std::string& query) {
    std::vector<std::string> ids;
    const json page = GetJson("/sessions.json" + query);
    for (const json& session : page["sessions"]) {
      ids.push_back(session["session_id"]);
    }
    return ids;
  }
};

TEST_F(StatusPagesTest, ThePageAndItsFilesComeFromTheProgramAlone) {
  const HttpReply page = Get("/");
  EXPECT_EQ(page.code, 200);
  EXPECT_THAT(page.headers, HasSubstr("Content-Type: text/html; charset=utf-8"));
  EXPECT_THAT(page.headers, HasSubstr("Content-Security-Policy: default-src 'none'"));
  EXPECT_THAT(page.headers, HasSubstr("X-Content-Type-Options: nosniff"));
  EXPECT_THAT(page.body, HasSubstr("<title>spikeserve</title>"));
  EXPECT_THAT(page.body, ::testing::Not(HasSubstr("http://")));
  EXPECT_THAT(page.body, ::testing::Not(HasSubstr("https://")));
  EXPECT_THAT(Get("/main.js").headers, HasSubstr("Content-Type: text/javascript"));
  EXPECT_THAT(Get("/style.css").headers, HasSubstr("Content-Type: text/css"));
  EXPECT_THAT(Get("/vendor/uplot/LICENSE").body, HasSubstr("The MIT License"));
  EXPECT_EQ(Get("/nothing").code, 404);
  EXPECT_EQ(Get("/../CMakeLists.txt").code, 404);
}

TEST_F(StatusPagesTest, StatusHoldsPoliciesAndTheFiguresOfMetrics) {
  Play("discrete", 7);
  const json status = GetJson("/status.json");
  EXPECT_TRUE(status["serving"]);
  EXPECT_GT(status["time"], 0.0);
  ASSERT_EQ(status["policies"].size(), 3u);
  EXPECT_EQ(status["policies"][2]["name"], "discrete");
  EXPECT_EQ(status["policies"][2]["version"], "2");
  EXPECT_TRUE(status["policies"][2]["is_default"]);

  double decisions = 0.0;
  for (const json& series : status["metrics"]["spikeserve_decisions_total"]) {
    if (series["labels"]["version"] == "2") decisions += series["value"].get<double>();
  }
  EXPECT_EQ(decisions, 7.0);
  for (const json& series : status["metrics"]["spikeserve_decision_duration_seconds"]) {
    const bool played = series["labels"] == json{{"policy", "discrete"}, {"version", "2"}};
    EXPECT_EQ(series["count"], played ? 7 : 0);
    EXPECT_EQ(series["buckets"].back()[0], nullptr);  // infinity
    EXPECT_EQ(series["buckets"].back()[1], series["count"]);
  }

  // Every metric of the document is also one of /metrics.
  std::set<std::string> families;
  for (const auto& [name, series] : status["metrics"].items()) families.insert(name);
  for (const std::string& name : families)
    EXPECT_THAT(Page("/metrics"), HasSubstr("# TYPE " + name));
}

TEST_F(StatusPagesTest, SessionsAreFilteredSortedAndPaged) {
  const std::string busy = Play("discrete", 9, {{"robot", "Marvin"}, {"Site", "Ulm"}});
  const std::string idle = Play("box", 1, {{"robot", "C-3PO"}});
  const std::string middling = Play("discrete", 4);
  EXPECT_THAT(SessionIds("?sort=decisions&order=descending"), ElementsAre(busy, middling, idle));
  EXPECT_THAT(SessionIds("?sort=decisions"), ElementsAre(idle, middling, busy));
  EXPECT_THAT(SessionIds("?filter=discrete%2F2&sort=step"), ElementsAre(middling, busy));
  EXPECT_THAT(SessionIds("?filter=robot=marvin"), ElementsAre(busy));
  EXPECT_THAT(SessionIds("?filter=site%3DULM"), ElementsAre(busy));
  EXPECT_THAT(SessionIds("?filter=" + idle), ElementsAre(idle));
  // A match lies within one label.
  for (const char* both : {"ulmrobot", "ulm%FFrobot", "%FF"}) {
    EXPECT_THAT(SessionIds(std::string("?filter=") + both), IsEmpty()) << both;
  }

  const json page = GetJson("/sessions.json?filter=box&page_size=5");
  EXPECT_EQ(page["open"], 3);
  EXPECT_EQ(page["matching"], 1);
  const json session = page["sessions"][0];
  EXPECT_EQ(session["policy"], "box");
  EXPECT_EQ(session["version"], "1");
  EXPECT_EQ(session["step"], "1");
  EXPECT_EQ(session["labels"]["robot"], "C-3PO");
  EXPECT_GT(session["energy_joules"], 0.0);
  EXPECT_EQ(page["next_page_token"], "");
}

// The pages add up to the whole list although a session that was listed already continues.
TEST_F(StatusPagesTest, PagesOfSessionsContinueBehindTheLastOne) {
  for (int64_t i = 0; i < 7; ++i) Play("discrete", 1 + i % 3);
  const std::vector<std::string> expected = SessionIds("?sort=decisions&order=descending");
  std::vector<std::string> listed;
  std::string token;
  do {
    const json page =
        GetJson("/sessions.json?sort=decisions&order=descending&page_size=3&page_token=" + token);
    EXPECT_LE(page["sessions"].size(), 3u);
    for (const json& session : page["sessions"]) listed.push_back(session["session_id"]);
    if (token.empty()) client_->Act(listed[0], 3);
    token = page["next_page_token"];
  } while (!token.empty());
  EXPECT_EQ(listed, expected);
}

TEST_F(StatusPagesTest, SessionsWithoutAnEndedEpisodeHaveNoReturn) {
  const std::string good = Play("discrete", 2);
  const std::string bad = Play("discrete", 2);
  const std::string fresh = Play("discrete", 2);
  client_->EndEpisode(good, 5.0);
  client_->EndEpisode(bad, -5.0);
  EXPECT_THAT(SessionIds("?sort=mean_return"), ElementsAre(bad, good, fresh));
  EXPECT_THAT(SessionIds("?sort=mean_return&order=descending"), ElementsAre(good, bad, fresh));
  EXPECT_EQ(GetJson("/sessions.json?filter=" + fresh)["sessions"][0]["mean_return"], nullptr);
}

TEST_F(StatusPagesTest, ASessionHasTheHistoryOfItsLife) {
  const std::string id = Play("discrete", 70);
  client_->EndEpisode(id, 5.0);
  const json session = GetJson("/session.json?session=" + id);
  EXPECT_EQ(session["session_id"], id);
  EXPECT_EQ(session["decisions"], "70");
  int64_t next = 0;
  double spikes = 0.0;
  for (const json& part : session["history"]["decisions"]) {
    EXPECT_EQ(part["first"], next);
    next += part["count"].get<int64_t>();
    spikes += part["spikes_per_decision"].get<double>() * part["count"].get<double>();
  }
  EXPECT_EQ(next, 70);
  EXPECT_NEAR(spikes, std::stod(session["spikes"].get<std::string>()), 1.0);
  ASSERT_EQ(session["history"]["episodes"].size(), 1u);
  EXPECT_EQ(session["history"]["episodes"][0]["mean_return"], session["last_return"]);
}

// The history is collected every two seconds, so the decisions appear a little later.
TEST_F(StatusPagesTest, FiguresAndTheirHistoryCountWhatAgentsDo) {
  Play("discrete", 7);
  json status;
  do {
    status = GetJson("/status.json?window=600&metrics=false");
  } while (status["figures"]["decisions"] != 7.0);
  EXPECT_EQ(status["metrics"], json::object());
  for (const json& version : status["versions"]) {
    const bool played = version["policy"] == "discrete" && version["version"] == "2";
    EXPECT_EQ(version["decisions"], played ? 7.0 : 0.0);
  }
  EXPECT_GT(status["figures"]["spikes_per_decision"], 0.0);
  EXPECT_FALSE(status["alerts"].empty());

  const json history = GetJson("/history.json?seconds=600");
  ASSERT_EQ(history["versions"].size(), 1u);
  const json version = history["versions"][0];
  EXPECT_EQ(version["policy"], "discrete");
  EXPECT_EQ(version["decisions_per_second"].size(), history["seconds_ago"].size());
}

TEST_F(StatusPagesTest, EveryColumnCanBeSortedBy) {
  Play("discrete", 2);
  Play("box", 1);
  for (const std::string column :
       {"session_id", "policy", "episode", "step", "episode_return", "decisions", "mean_return",
        "last_return", "spikes_per_decision", "energy_joules", "head_drift", "idle_seconds"}) {
    EXPECT_EQ(SessionIds("?sort=" + column).size(), 2u) << column;
  }
}

TEST_F(StatusPagesTest, ExplainsASessionsLastDecision) {
  const std::string session = Play("discrete", 6);
  const json explained = GetJson("/explain.json?session=" + session);
  EXPECT_EQ(explained["session_id"], session);
  EXPECT_EQ(explained["answer"]["step"], "5");
  size_t spikes = 0;
  for (const json& raster : explained["rasters"]) spikes += raster["ticks"].size();
  EXPECT_EQ(explained["answer"]["stats"]["spikes"], std::to_string(spikes));
}

TEST_F(StatusPagesTest, MistakesAreNamed) {
  const auto expect_error = [&](const std::string& path, int http, const std::string& code,
                                const std::string& message) {
    const json error = GetJson(path, http);
    EXPECT_EQ(error["code"], code) << path;
    EXPECT_THAT(error["message"].get<std::string>(), HasSubstr(message)) << path;
  };
  expect_error("/explain.json?session=nobody", 404, "NOT_FOUND", "nobody");
  expect_error("/explain.json", 404, "NOT_FOUND", "session_id: expected");
  expect_error("/explain.json?session=" + client_->Open(), 409, "FAILED_PRECONDITION", "step 0");
  expect_error("/sessions.json?page_size=0", 400, "INVALID_ARGUMENT", "page_size: expected");
  expect_error("/sessions.json?page_size=1001", 400, "INVALID_ARGUMENT", "page_size: expected");
  std::string deep;  // CBOR: arrays in arrays
  for (int i = 0; i < 3000; ++i) deep += "gYGB";
  // The last two: an array and a map that claim 2^61 elements.
  for (const std::string token :
       {"x", "AAAA", "%FF", "hPWA", deep.c_str(), "myAAAAAAAAAA", "uyAAAAAAAAAA"}) {
    expect_error("/sessions.json?page_token=" + token, 400, "INVALID_ARGUMENT", "page_token: ");
  }
  Play("discrete", 1);
  const std::string token = GetJson("/sessions.json?page_size=1")["next_page_token"];
  ASSERT_NE(token, "");
  expect_error("/sessions.json?sort=step&page_token=" + token, 400, "INVALID_ARGUMENT",
               "the same sort and order");
  expect_error("/session.json?session=nobody", 404, "NOT_FOUND", "nobody");
  expect_error("/status.json?window=0", 400, "INVALID_ARGUMENT", "window: expected");
  expect_error("/status.json?metrics=no", 400, "INVALID_ARGUMENT", "metrics: expected");
  expect_error("/history.json?seconds=1801", 400, "INVALID_ARGUMENT", "seconds: expected");
  expect_error("/sessions.json?sort=mood", 400, "INVALID_ARGUMENT", "sort: expected one of");
  expect_error("/sessions.json?order=up", 400, "INVALID_ARGUMENT", "order: expected");
  expect_error("/sessions.json?colour=red", 400, "INVALID_ARGUMENT", "\"colour\"");
  expect_error("/sessions.json?sort=%FF%FE", 400, "INVALID_ARGUMENT", "sort: expected one of");
}

// Reading the list of sessions does not keep them alive.
TEST_F(StatusPagesTest, WatchingIsNoUse) {
  StartServer({"--session_ttl=1s"});
  Play("discrete", 1);
  while (Metric("spikeserve_sessions_reaped_total") == 0.0) GetJson("/sessions.json");
  EXPECT_EQ(GetJson("/sessions.json")["open"], 0);
}

}  // namespace
}  // namespace spikeserve
