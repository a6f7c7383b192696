#include "server/web/session_list.h"

#include <gtest/gtest.h>

#include <map>
#include <string>
#include <utility>

#include "nlohmann/json.hpp"
#include "proto/json.h"
#include "server/admin/session_info.h"
#include "tests/support/policy_handler_fixture.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

class SessionListTest : public PolicyHandlerFixture {
 protected:
  // Opens a session that learns, and returns its id.
  std::string OpenOne() {
    v1::OpenSessionRequest request;
    request.mutable_learning()->set_scope(v1::LearningConfig::SESSION);
    (*request.mutable_labels())["robot"] = "R2 \"D2\"";
    (*request.mutable_labels())["Straße"] = "7\\";
    request.set_period_seconds(0.02);
    return MustOpen(std::move(request));
  }

  void Act(const std::string& id, int64_t step, double reward) {
    v1::ActRequest request = MakeRequest(id, step);
    request.set_reward(reward);
    request.mutable_report()->set_held(7);
    v1::ActResponse response;
    DeferredWork deferred;
    const auto status = Decide(request, &response, &deferred);
    ASSERT_TRUE(status.ok()) << status;
    deferred.Run();
  }

  Json List(const std::multimap<std::string, std::string>& parameters) {
    const auto query = HttpQuery::Parse(parameters, {"filter", "sort", "order", "page_size"});
    EXPECT_TRUE(query.ok()) << query.status();
    const auto list = SessionsJson(store_, *caller_, *query);
    EXPECT_TRUE(list.ok()) << list.status();
    return Json::parse(*list);
  }

  // Expects that the row has every field of SessionInfo, as protobuf writes it in JSON.
  void ExpectEveryField(const Json& row, const std::string& id) {
    v1::SessionInfo info;
    ToProto(*store_.PeekListed(id), &info);
    const Json expected = Json::parse(*MessageToJson(info));
    EXPECT_EQ(expected.size(), v1::SessionInfo::descriptor()->field_count());
    for (const auto& [field, value] : expected.items()) {
      EXPECT_EQ(row.value(field, Json("absent")), value) << field;
    }
  }
};

TEST_F(SessionListTest, ARowHasEveryFieldOfSessionInfo) {
  const std::string id = OpenOne();
  Act(id, /*step=*/0, /*reward=*/0.0);
  ExpectEveryField(List({})["sessions"][0], id);
  for (int64_t step = 1; step < 5; ++step) Act(id, step, /*reward=*/0.1);
  clock_.Advance(absl::Milliseconds(1234));
  const Json row = List({{"sort", "energy_joules"}, {"filter", "straße=7"}})["sessions"][0];
  ExpectEveryField(row, id);
  EXPECT_EQ(row["decisions"], "5");
  EXPECT_EQ(row["idle_seconds"], 1.234);
  EXPECT_EQ(row["ended_episodes"], 0);
  EXPECT_EQ(row["mean_return"], Json());
  EXPECT_EQ(Json::parse(*SessionJson(store_, *caller_, id, /*unusual_deviations=*/3.0))["labels"],
            row["labels"]);
}

}  // namespace
}  // namespace spikeserve
