#include "spikeserve/status.h"

#include "gtest/gtest.h"

namespace spikeserve {
namespace {

TEST(StatusTest, KeepsCodeAndMessage) {
  EXPECT_TRUE(StatusFromGrpc(grpc::Status::OK).ok());
  EXPECT_EQ(StatusFromGrpc({grpc::StatusCode::NOT_FOUND, "session_id: no such session"}),
            absl::NotFoundError("session_id: no such session"));
  EXPECT_EQ(StatusFromGrpc({grpc::StatusCode::UNAUTHENTICATED, "who?"}),
            absl::UnauthenticatedError("who?"));
  EXPECT_EQ(StatusFromCode(8, "full"), absl::ResourceExhaustedError("full"));
}

TEST(StatusTest, UnknownCodesStayErrors) {
  EXPECT_EQ(StatusFromCode(17, "new"), absl::UnknownError("status code 17: new"));
  EXPECT_EQ(StatusFromCode(-1, "odd"), absl::UnknownError("status code -1: odd"));
}

TEST(StatusTest, AResetByAProxyIsUnavailable) {
  const std::string reset = "Received RST_STREAM with error code 2";
  EXPECT_EQ(StatusFromGrpc({grpc::StatusCode::INTERNAL, reset}), absl::UnavailableError(reset));
  EXPECT_TRUE(absl::IsInternal(StatusFromGrpc({grpc::StatusCode::INTERNAL, "a bug"})));
}

TEST(StatusTest, KeepsTheExpectedDecision) {
  const absl::Status status = StatusFromCode(9, "decision: expected 7, received 9", {}, 7);
  EXPECT_EQ(ExpectedDecision(status), 7u);
  EXPECT_EQ(ExpectedDecision(absl::FailedPreconditionError("step")), std::nullopt);
}

TEST(StatusTest, SaysWhichAnswerDiverged) {
  const absl::Status status = DivergedError("mine", 12);
  EXPECT_TRUE(absl::IsDataLoss(status));
  EXPECT_EQ(DivergedAt(status), 12u);
  EXPECT_EQ(DivergedAt(absl::DataLossError("other")), std::nullopt);
}

}  // namespace
}  // namespace spikeserve
