#include "server/web/status_pages.h"

#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "absl/time/time.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"
#include "proto/json.h"
#include "server/access/admission.h"
#include "server/base/http_query.h"
#include "server/web/embedded_files.h"
#include "server/web/session_list.h"
#include "server/web/status_json.h"

namespace spikeserve {
namespace {

constexpr size_t kMaxWaitingPages =
    16;  // requests of one tenant, or of one address where there are none

// The windows of /status.json and /history.json, in seconds.
constexpr int64_t kDefaultWindow = 60;
constexpr int64_t kLongestWindow = 1'000'000'000;  // longer than any server runs
constexpr int64_t kDefaultHistory = 600;

absl::string_view ContentTypeOf(absl::string_view file) {
  if (absl::EndsWith(file, ".html")) return "text/html; charset=utf-8";
  if (absl::EndsWith(file, ".css")) return "text/css; charset=utf-8";
  if (absl::EndsWith(file, ".json")) return "application/schema+json";
  if (absl::EndsWith(file, ".js")) return "text/javascript; charset=utf-8";
  return "text/plain; charset=utf-8";
}

// Returns the file of the status page at `path`, or 404.
HttpResponse FileResponse(absl::string_view path) {
  const absl::string_view name = path == "/" ? "index.html" : absl::StripPrefix(path, "/");
  const auto file = EmbeddedFiles().find(name);
  if (file == EmbeddedFiles().end()) {
    return {.code = 404,
            .body =
                "expected /, /metrics, /healthz, /schema.json, /status.json, /history.json, "
                "/sessions.json, /session.json, /usage.json, /explain.json or /watch\n"};
  }
  return {.code = 200,
          .content_type = std::string(ContentTypeOf(name)),
          .body = std::string(file->second)};
}

HttpResponse JsonResponse(absl::StatusOr<std::string> json) {
  return {.code = json.ok() ? 200 : HttpCode(json.status().code()),
          .content_type = "application/json",
          .body = json.ok() ? *std::move(json) : ErrorJson(json.status())};
}

// Returns what distinguishes the page that a request gets. Lists of sessions and usage depend on
// the caller.
std::string KeyOf(const HttpRequest& request, const Credential& caller) {
  std::string key = request.path;
  if (request.path == "/sessions.json" || request.path == "/usage.json") {
    absl::StrAppend(&key, " ", reinterpret_cast<uintptr_t>(&caller));
  }
  for (const auto& [name, value] : request.parameters) {
    absl::StrAppend(&key, " ", Quoted(name), "=", Quoted(value));
  }
  return key;
}

}  // namespace

StatusPages::StatusPages(Parts parts)
    : parts_(std::move(parts)),
      feeds_({.store = parts_.store, .clock = parts_.clock, .worker = parts_.worker}),
      health_(kMaxWaitingPages, BackgroundWorker::Priority::kNormal),
      metrics_(kMaxWaitingPages, BackgroundWorker::Priority::kNormal),
      pages_(kMaxWaitingPages) {}

void StatusPages::Answer(HttpRequest request, HttpServer::Done done) {
  const auto submit = [&](BackgroundWorker& worker, const std::string& group,
                          std::function<void()> work) {
    const auto accepted = worker.Submit(group, std::move(work));
    if (!accepted.ok()) done({.code = 503, .body = absl::StrCat(accepted.message(), "\n")});
  };
  if (request.path == "/healthz")
    return submit(health_, request.peer.address, [this, done] { done(Health()); });
  const absl::Duration now = parts_.clock->Now();
  const auto caller = AdmitToPages(*parts_.authenticator, request.authorization);
  if (!caller.ok()) {
    return done({.code = absl::IsUnauthenticated(caller.status()) ? 401 : 403,
                 .body = absl::StrCat(caller.status().message(), "\n"),
                 .delay = DelayOf(caller, caller.status())});
  }
  // A proxy brings many tenants from one address, and a tenant may have many addresses.
  const std::string& tenant = (*caller)->tenant()->name();
  const std::string& group = tenant.empty() ? request.peer.address : tenant;
  if (request.path == "/metrics") {
    return submit(metrics_, group, [this, round = shared_.Join(request.path), done] {
      done({.code = 200,
            .content_type = "text/plain; version=0.0.4; charset=utf-8",
            .body = *shared_.Get(*round, [this] { return parts_.metrics->ToText(); })});
    });
  }
  if (absl::EndsWith(request.path, ".json") || request.path == "/watch") {
    const auto status = (*caller)->tenant()->AcquireCall(Cost::kListing, now);
    if (!status.ok()) {
      HttpResponse refusal = JsonResponse(status);
      refusal.delay = DelayOf(caller, status);
      return done(std::move(refusal));
    }
  }
  submit(pages_, group,
         [this, caller = *caller, request, round = shared_.Join(KeyOf(request, **caller)), done] {
           AnswerPage(caller, request, *round, done);
         });
}

absl::Duration StatusPages::DelayOf(const absl::StatusOr<std::shared_ptr<const Credential>>& caller,
                                    const absl::Status& refusal) const {
  return parts_.authenticator->RefusalPacerFor(caller).DelayFor(refusal, /*request_bytes=*/0,
                                                                parts_.clock->Now());
}

void StatusPages::AnswerPage(const std::shared_ptr<const Credential>& caller,
                             const HttpRequest& request, SharedAnswers::Round& round,
                             const HttpServer::Done& done) {
  const absl::string_view path = request.path;
  const auto share = [&](absl::FunctionRef<absl::StatusOr<std::string>()> make) {
    done(JsonResponse(shared_.Get(round, make)));
  };
  if (path == "/status.json") return share([&] { return Status(*caller, request); });
  if (path == "/history.json") return share([&] { return History(request); });
  if (path == "/sessions.json") return share([&] { return Sessions(*caller, request); });
  if (path == "/usage.json") return share([&] { return Usage(*caller, request); });
  if (path == "/session.json") return done(JsonResponse(Session(*caller, request)));
  if (path == "/explain.json") return Explain(caller, request, done);
  if (path == "/watch") return Watch(caller, request, done);
  done(FileResponse(path));
}

HttpResponse StatusPages::Health() const {
  const bool serving = parts_.serving();
  return {.code = serving ? 200 : 503, .body = serving ? "SERVING\n" : "NOT_SERVING\n"};
}

absl::StatusOr<std::string> StatusPages::Status(const Credential& caller,
                                                const HttpRequest& request) const {
  ASSIGN_OR_RETURN(const auto query, HttpQuery::Parse(request.parameters, {"window", "metrics"}));
  ASSIGN_OR_RETURN(const auto window,
                   query.GetInteger("window", kDefaultWindow, 1, kLongestWindow));
  const std::string metrics = query.Get("metrics", "true");
  if (metrics != "true" && metrics != "false") {
    return absl::InvalidArgumentError(
        absl::StrCat("metrics: expected true or false, received ", Quoted(metrics)));
  }
  CallContext context{.caller = &caller};
  v1::ListPoliciesResponse policies;
  if (auto status = parts_.handler->ListPolicies(context, {}, &policies); !status.ok())
    return status;
  v1::ListRolloutsResponse rollouts;
  if (auto status = parts_.admin->ListRollouts(context, {}, &rollouts); !status.ok()) return status;
  std::vector<prometheus::MetricFamily> families;
  if (metrics == "true") families = parts_.metrics->Collect();
  return StatusJson(parts_.history->Status(absl::Seconds(window)), families, policies, rollouts,
                    {.time = absl::ToDoubleSeconds(parts_.clock->Now()),
                     .serving = parts_.serving(),
                     .store = parts_.store_address,
                     .replica = parts_.replicas->self(),
                     .replicas = parts_.replicas->count(),
                     .reports = parts_.reports->Get()});
}

absl::StatusOr<std::string> StatusPages::History(const HttpRequest& request) const {
  ASSIGN_OR_RETURN(const auto query, HttpQuery::Parse(request.parameters, {"seconds"}));
  ASSIGN_OR_RETURN(const auto seconds,
                   query.GetInteger("seconds", kDefaultHistory, 1,
                                    absl::ToInt64Seconds(ServerHistory::kLongest)));
  return parts_.history->Over(absl::Seconds(seconds)).dump();
}

absl::StatusOr<std::string> StatusPages::Session(const Credential& caller,
                                                 const HttpRequest& request) const {
  ASSIGN_OR_RETURN(const auto query, HttpQuery::Parse(request.parameters, {"session"}));
  return SessionJson(*parts_.store, caller, query.Get("session"), parts_.unusual_deviations);
}

absl::StatusOr<std::string> StatusPages::Sessions(const Credential& caller,
                                                  const HttpRequest& request) const {
  ASSIGN_OR_RETURN(
      const auto query,
      HttpQuery::Parse(request.parameters, {"filter", "sort", "order", "page_size", "page_token"}));
  return SessionsJson(*parts_.store, caller, query);
}

absl::StatusOr<std::string> StatusPages::Usage(const Credential& caller,
                                               const HttpRequest& request) const {
  ASSIGN_OR_RETURN(const auto query, HttpQuery::Parse(request.parameters, {"month", "by"}));
  v1::GetUsageRequest usage;
  usage.set_month(query.Get("month"));
  for (const auto& key : absl::StrSplit(query.Get("by"), ',', absl::SkipEmpty())) {
    usage.add_by(std::string(key));
  }
  CallContext context{.caller = &caller};
  v1::GetUsageResponse response;
  RETURN_IF_ERROR(parts_.admin->GetUsage(context, usage, &response));
  return JsonText(MessageToFields(response));
}

void StatusPages::Explain(const std::shared_ptr<const Credential>& caller,
                          const HttpRequest& request, const HttpServer::Done& done) const {
  const auto parsed = HttpQuery::Parse(request.parameters, {"session"});
  if (!parsed.ok()) return done(JsonResponse(parsed.status()));
  const absl::Status within_rate =
      caller->tenant()->AcquireCall(Cost::kExplain, parts_.clock->Now());
  if (!within_rate.ok()) {
    HttpResponse refusal = JsonResponse(within_rate);
    refusal.delay = DelayOf(caller, within_rate);
    return done(std::move(refusal));
  }
  v1::ExplainRequest explain;
  explain.set_session_id(parsed->Get("session"));
  const auto work = [handler = parts_.handler, caller, explain, done] {
    v1::ExplainResponse response;
    CallContext context{.caller = caller.get()};
    const absl::Status explained = handler->Explain(context, explain, &response);
    if (!explained.ok()) return done(JsonResponse(explained));
    done(JsonResponse(JsonText(MessageToFields(response))));
  };
  const absl::Status accepted = parts_.worker->Submit(caller->tenant()->name(), work);
  if (!accepted.ok()) done(JsonResponse(accepted));
}

void StatusPages::Watch(const std::shared_ptr<const Credential>& caller, const HttpRequest& request,
                        const HttpServer::Done& done) {
  const auto parsed = HttpQuery::Parse(request.parameters, {"session"});
  if (!parsed.ok()) return done(JsonResponse(parsed.status()));
  auto feed = feeds_.Open(caller, request.peer.address, parsed->Get("session"));
  if (!feed.ok()) return done(JsonResponse(feed.status()));
  // nginx would gather events otherwise.
  done({.content_type = "text/event-stream",
        .body = "retry: 3000\n\n",  // milliseconds after a lost connection
        .headers = "X-Accel-Buffering: no\r\n",
        .feed = *std::move(feed)});
}

}  // namespace spikeserve
