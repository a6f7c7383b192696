#include "server/transport/grpc_wire.h"

#include <gtest/gtest.h>

#include "absl/strings/cord.h"
#include "absl/strings/match.h"
#include "google/rpc/status.pb.h"

namespace spikeserve {
namespace {

TEST(GrpcWireTest, AMessageHasAPrefix) {
  google::rpc::Status message;
  message.set_code(5);
  std::string bytes = "before";
  AppendMessage(message, &bytes);
  EXPECT_EQ(bytes, std::string("before\0\0\0\0\x02\x08\x05", 13));
  const MessagePrefix prefix = ParseMessagePrefix(bytes.substr(6));
  EXPECT_FALSE(prefix.compressed);
  EXPECT_EQ(prefix.length, 2);
}

TEST(GrpcWireTest, AnEmptyMessageIsItsPrefix) {
  std::string bytes;
  AppendMessage(google::rpc::Status(), &bytes);
  EXPECT_EQ(bytes, std::string(5, '\0'));
}

TEST(GrpcWireTest, TheLengthHasTheMostSignificantByteFirst) {
  const MessagePrefix prefix = ParseMessagePrefix("\x01\xff\x02\x03\x04");
  EXPECT_TRUE(prefix.compressed);
  EXPECT_EQ(prefix.length, 0xff020304);
}

TEST(GrpcWireTest, HeadersOfAStatusAreShort) {
  // Clients refuse more than 8 KiB.
  std::string text = "policy: expected one of ";
  while (text.size() < 100'000) text += "\u00fc";
  absl::Status status = absl::NotFoundError(text);
  status.SetPayload("type.googleapis.com/test", absl::Cord("x"));
  const StatusHeaders headers = StatusHeadersOf(status);
  EXPECT_LT(headers.message.size() + headers.details.size(), 6000u);
  EXPECT_TRUE(absl::StartsWith(headers.message, "policy: expected one of %C3%BC"));
  EXPECT_TRUE(absl::EndsWith(headers.message, "%C3%BC... (cut)"));
  EXPECT_EQ(StatusHeadersOf(absl::NotFoundError("short")).message, "short");
}

TEST(GrpcWireTest, MessagesArePercentEncoded) {
  EXPECT_EQ(PercentEncode("step: expected 3 ~ 4"), "step: expected 3 ~ 4");
  EXPECT_EQ(PercentEncode("100%\n\x7f"), "100%25%0A%7F");
  EXPECT_EQ(PercentEncode("ü"), "%C3%BC");
}

TEST(GrpcWireTest, TimeoutsHaveUnits) {
  EXPECT_EQ(*ParseTimeout("2H"), absl::Hours(2));
  EXPECT_EQ(*ParseTimeout("3M"), absl::Minutes(3));
  EXPECT_EQ(*ParseTimeout("4S"), absl::Seconds(4));
  EXPECT_EQ(*ParseTimeout("99999999m"), absl::Milliseconds(99'999'999));
  EXPECT_EQ(*ParseTimeout("6u"), absl::Microseconds(6));
  EXPECT_EQ(*ParseTimeout("0n"), absl::ZeroDuration());
}

TEST(GrpcWireTest, OtherTimeoutsAreRefused) {
  for (const char* text : {"", "S", "1", "1s", "-1S", "+1S", " 1S", "1.5S", "123456789S", "1 S"}) {
    EXPECT_EQ(ParseTimeout(text).status().message(),
              std::string("grpc-timeout: expected 1 to 8 digits and one of H, M, S, m, u, n, "
                          "received \"") +
                  text + "\"");
  }
}

TEST(GrpcWireTest, ContentTypes) {
  for (const char* type :
       {"application/grpc", "application/grpc+proto", "application/grpc;charset=utf-8"}) {
    EXPECT_TRUE(IsGrpcContentType(type)) << type;
  }
  for (const char* type : {"", "application/json", "application/grpc-web", "application/grpc+json",
                           "application/grpcproto"}) {
    EXPECT_FALSE(IsGrpcContentType(type)) << type;
  }
}

}  // namespace
}  // namespace spikeserve
