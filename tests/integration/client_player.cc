// Plays sessions with the C++ client, as the lines of its standard input say.
//
//   client_player SERVERS calls|batch|stream [CA]
//
// With CA, a file of authorities, it uses TLS.
//
// Messages are in hexadecimal. Sessions are counted from 0 in the order of their opening. Each line
// is answered by one line: the response, or "error" and a status.
//
//   open OpenSessionRequest    opens a session
//   act ActBatchRequest        acts with the observation and reward of item i in session i, for all
//   end I EndEpisodeRequest    ends the episode of session I
//   state I                    returns the GetSessionResponse of session I
//   close I                    closes session I
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "absl/strings/escaping.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/hex.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

constexpr int kMostRounds = 100;  // of decisions that servers miss, in a batch

template <typename Message>
Message Parse(const std::string& hex) {
  Message message;
  if (!message.ParseFromString(ParseHex(hex).value())) std::abort();
  return message;
}

template <typename Message>
std::string Print(const absl::StatusOr<Message>& message) {
  if (!message.ok()) return absl::StrCat("error ", message.status().ToString());
  return absl::BytesToHexString(message->SerializeAsString());
}

class Player {
 public:
  Player(Client* client, std::string mode) : client_(client), mode_(std::move(mode)) {
    if (mode_ == "stream") stream_ = client_->OpenStream();
  }

  std::string Do(const std::vector<std::string>& words) {
    if (words[0] == "open") {
      auto session = RemoteSession::Open(client_, Parse<v1::OpenSessionRequest>(words[1]));
      if (!session.ok()) return absl::StrCat("error ", session.status().ToString());
      sessions_.push_back(*std::move(session));
      return Print<v1::OpenSessionResponse>(sessions_.back().opening());
    }
    if (words[0] == "act") return Print(Act(Parse<v1::ActBatchRequest>(words[1])));
    RemoteSession& session = sessions_.at(std::stoul(words[1]));
    if (words[0] == "end") {
      const auto request = Parse<v1::EndEpisodeRequest>(words[2]);
      return Print(session.EndEpisode({.reward = request.reward(),
                                       .terminated = request.terminated(),
                                       .truncated = request.truncated()}));
    }
    if (words[0] == "state") return Print(session.State(/*include_head_delta=*/true));
    const absl::Status closed = session.Close();
    return closed.ok() ? "ok" : absl::StrCat("error ", closed.ToString());
  }

 private:
  absl::StatusOr<v1::ActBatchResponse> Act(const v1::ActBatchRequest& items) {
    if (mode_ == "batch") return ActInBatches(items);
    if (mode_ == "stream") return ActOnStream(items);
    v1::ActBatchResponse answers;
    for (int i = 0; i < items.requests_size(); ++i) {
      const v1::ActRequest& item = items.requests(i);
      auto answer = sessions_[i].Act(item.observation(), item.reward());
      if (!answer.ok()) return answer.status();
      *answers.add_results()->mutable_response() = *std::move(answer);
    }
    return answers;
  }

  absl::StatusOr<v1::ActBatchResponse> ActOnStream(const v1::ActBatchRequest& items) {
    for (int i = 0; i < items.requests_size(); ++i) {
      const v1::ActRequest& item = items.requests(i);
      auto status = stream_->Send(&sessions_[i], item.observation(), item.reward());
      if (!status.ok()) return status;
    }
    v1::ActBatchResponse answers;
    for (int i = 0; i < items.requests_size(); ++i) answers.add_results();
    for (int i = 0; i < items.requests_size(); ++i) {
      auto reply = stream_->Receive(absl::Minutes(5));
      if (!reply.ok()) return reply.status();
      if (!reply->response.ok()) return reply->response.status();
      const auto row = static_cast<int>(reply->session - sessions_.data());
      *answers.mutable_results(row)->mutable_response() = *std::move(reply->response);
    }
    return answers;
  }

  absl::StatusOr<v1::ActBatchResponse> ActInBatches(const v1::ActBatchRequest& items) {
    v1::ActBatchResponse answers;
    std::vector<size_t> rows;  // without an answer
    for (int i = 0; i < items.requests_size(); ++i) {
      answers.add_results();
      rows.push_back(static_cast<size_t>(i));
    }
    for (int round = 0; !rows.empty(); ++round) {
      std::vector<v1::ActRequest> requests;
      for (const size_t row : rows) {
        const v1::ActRequest& item = items.requests(static_cast<int>(row));
        requests.push_back(sessions_[row].MakeRequest(item.observation(), item.reward()));
      }
      auto results = client_->ActBatch(requests);
      if (!results.ok()) return results.status();
      std::vector<size_t> again;
      for (size_t i = 0; i < rows.size(); ++i) {
        auto& result = (*results)[i];
        absl::Status status = result.ok() ? sessions_[rows[i]].Accept(*result)
                                          : sessions_[rows[i]].CatchUp(result.status());
        if (!status.ok() || round == kMostRounds) return status;
        if (result.ok()) {
          *answers.mutable_results(static_cast<int>(rows[i]))->mutable_response() =
              *std::move(result);
        } else {
          again.push_back(rows[i]);
        }
      }
      rows = std::move(again);
    }
    return answers;
  }

  Client* const client_;
  const std::string mode_;
  std::unique_ptr<RemoteStream> stream_;
  std::vector<RemoteSession> sessions_;
};

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  if (argc < 3 || argc > 4) return 1;
  spikeserve::ClientOptions options;
  options.call_timeout = absl::Seconds(1);  // a stopped server is given up after this time
  options.retry.max_elapsed = absl::Minutes(1);
  if (argc == 4) options.security.ca = argv[3];
  const auto client = spikeserve::Client::Connect(argv[1], options, absl::Minutes(1));
  if (!client.ok()) return 1;
  spikeserve::Player player(client->get(), argv[2]);
  std::string line;
  while (std::getline(std::cin, line)) {
    const std::vector<std::string> words = absl::StrSplit(line, ' ');
    std::cout << player.Do(words) << std::endl;
  }
  return 0;
}
