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

}  // namespace
}  // namespace spikeserve
