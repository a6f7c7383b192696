#include "server/heads/head_requests.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;

HeadRequest Named(const std::string& name) {
  HeadRequest request;
  request.append.session = name;
  request.append.bytes = "entry";
  return request;
}

std::vector<std::string> NamesOf(const std::vector<HeadRequest>& requests) {
  std::vector<std::string> names;
  for (const HeadRequest& request : requests) names.push_back(request.append.session);
  return names;
}

TEST(HeadRequests, AreTakenInTheirOrderAndALimitedNumberAtATime) {
  int woken = 0;
  HeadRequests requests([&] { ++woken; });
  for (int i = 0; i < 20; ++i) requests.Add(Named(absl::StrCat(i)));
  EXPECT_EQ(woken, 20);
  const auto first = NamesOf(requests.Take());
  EXPECT_EQ(first.size(), 16u);
  EXPECT_EQ(first.back(), "15");
  EXPECT_EQ(woken, 21);  // there is more to take
  EXPECT_THAT(NamesOf(requests.Take()), ElementsAre("16", "17", "18", "19"));
  EXPECT_EQ(woken, 21);
  EXPECT_TRUE(requests.empty());
}

TEST(HeadRequests, ThoseThatArePutBackComeFirst) {
  HeadRequests requests([] {});
  requests.Add(Named("a"));
  requests.Add(Named("b"));
  auto taken = requests.Take();
  requests.Add(Named("c"));
  requests.PutBack(std::move(taken));
  EXPECT_THAT(NamesOf(requests.Take()), ElementsAre("a", "b", "c"));
}

TEST(HeadRequests, AnOperationGetsItsOutcomeOrItsError) {
  HeadRequest request = Named("a");
  request.operation = std::make_shared<HeadOperation>();
  request.OnMerged({.drift = 2.0});
  EXPECT_TRUE(request.operation->done.WaitFor(absl::ZeroDuration()));
  EXPECT_EQ(request.operation->outcome->drift, 2.0);
  request.OnError(absl::UnavailableError("stopped"));
  EXPECT_EQ(request.operation->outcome.status().message(), "stopped");
}

}  // namespace
}  // namespace spikeserve
