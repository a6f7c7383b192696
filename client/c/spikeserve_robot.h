// Flies one robot from C, and from each language that can call C: every control step has an action
// in time, whatever the link does. It is the C++ client's pilot, docs/reference/beats.md.
//
//   spikeserve_robot_options_t options;
//   spikeserve_robot_options_init(&options, sizeof options);
//   options.servers = "127.0.0.1:50051";
//   options.policy = "pendulum";
//   options.period = 0.02;
//   spikeserve_robot_t* robot = NULL;
//   spikeserve_robot_error_t error;
//   if (spikeserve_robot_open(&options, &robot, &error) != 0) return fail(error.message);
//   while (flying) {
//     spikeserve_robot_action_t action;
//     spikeserve_robot_step(robot, observation, 3, reward, NULL, &action, &error);
//     ...  // executes action.continuous, and waits for the next step
//   }
//   spikeserve_robot_close(robot);
//
// Times are seconds. Functions that can fail return 0, or the number of a gRPC status code, and
// fill in `error` unless it is NULL. No exception leaves them. A robot is for one thread at a time,
// but spikeserve_robot_stats and spikeserve_robot_session_id, which any thread may call.
//
// A process that links this library does not link the C++ client: the messages would be there
// twice.
//
// Structures that may grow begin with their size. A program goes on with each later library of the
// same SPIKESERVE_ROBOT_ABI, which is in the name of the library's file.
#ifndef SPIKESERVE_ROBOT_H_
#define SPIKESERVE_ROBOT_H_

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define SPIKESERVE_ROBOT_ABI 0

typedef struct spikeserve_robot spikeserve_robot_t;

// Why a function has failed. The codes are those of gRPC; these are the most frequent ones.
enum {
  SPIKESERVE_ROBOT_OK = 0,
  SPIKESERVE_ROBOT_INVALID_ARGUMENT = 3,
  SPIKESERVE_ROBOT_DEADLINE_EXCEEDED = 4,
  SPIKESERVE_ROBOT_NOT_FOUND = 5,
  SPIKESERVE_ROBOT_UNAVAILABLE = 14,
};
typedef struct {
  int32_t code;
  char message[508];  // "field: expected X, received Y"; cut off if it is longer
} spikeserve_robot_error_t;

// Who chose an action: the fallback order.
enum {
  SPIKESERVE_ROBOT_FRESH = 0,  // the server
  SPIKESERVE_ROBOT_HELD = 1,   // the server; the last fresh action again
  SPIKESERVE_ROBOT_LOCAL = 2,  // the engine on the robot
  SPIKESERVE_ROBOT_SAFE = 3,   // the neutral action, the way to it, or options.fallback
};

// Who chose an executed action, as ActionSource of the wire contract has it.
enum {
  SPIKESERVE_ROBOT_BY_UNKNOWN = 0,  // not said: the policy, if the action is the returned one
  SPIKESERVE_ROBOT_BY_POLICY = 1,
  SPIKESERVE_ROBOT_BY_OPERATOR = 2,
  SPIKESERVE_ROBOT_BY_SAFETY_LAYER = 3,
  SPIKESERVE_ROBOT_BY_HELD = 4,  // these, and HOLD, the robot says by itself
  SPIKESERVE_ROBOT_BY_LOCAL = 5,
  SPIKESERVE_ROBOT_BY_SAFE = 6,
  SPIKESERVE_ROBOT_BY_HOLD = 7,
};

// An action, in environment units. `source`, `age` and `step` are those of a returned one, `by` and
// `operator_id` those of a given one.
typedef struct {
  int64_t discrete;         // index, if the space is Discrete
  const float* continuous;  // one number for each element, if it is a Box
  size_t size;              // of `continuous`; 0: the space is Discrete
  int32_t source;
  double age;     // of the observation that the action was chosen for
  uint64_t step;  // counts the steps of the robot
  int32_t by;
  const char* operator_id;  // of an operator, at most 128 bytes; or NULL
} spikeserve_robot_action_t;

// Writes the robot's own action for an observation, whose elements are all NaN if that of the step
// is not valid. Returns 0 if there is one. Its memory must stay valid until the next call. Runs on
// the thread of spikeserve_robot_step, and counts for its time.
typedef int (*spikeserve_robot_fallback_t)(void* context, const float* observation, size_t size,
                                           spikeserve_robot_action_t* action);
// Takes a line when a source is entered or something fails, on a thread of the library.
typedef void (*spikeserve_robot_log_t)(void* context, const char* line);

// How the steps go to the server.
enum {
  SPIKESERVE_ROBOT_AUTO = 0,  // as datagrams where the server takes them and they come through
  SPIKESERVE_ROBOT_STREAM = 1,
  SPIKESERVE_ROBOT_DATAGRAM = 2,  // as AUTO; a server that takes no datagrams is refused
};

// The settings of a robot. Texts may be NULL, and are copied. A negative number stands for the
// default. spikeserve/pilot_options.h has more about each one.
typedef struct {
  size_t size;               // of this structure
  const char* servers;       // "HOST:PORT", or several of them, separated by commas
  const char* policy;        // its name
  const char* session;       // more fields of OpenSessionRequest, as JSON: {"version": 2}
  const char* local_policy;  // file for the engine on the robot; "": the server's; NULL: no engine
  const char* ca;            // PEM file with the authorities of the servers; implies TLS
  const char* certificate;   // PEM file of the client's own
  const char* key;           // PEM file
  const char* token;         // sent with each call
  double patience;           // how long to wait for a connection; default: 3
  double period;             // between two steps
  double budget;             // of one step; default: half a period
  double max_age;            // of an answer; default: 0.25, or three periods if that is more
  double close_timeout;      // how long to wait for the ends of episodes when closing; default: 5
  int32_t hold_beats;        // steps that the last fresh action is held; default: 3
  int32_t ramp_beats;        // steps on the way to the neutral action; default: those of 0.2 s
  int32_t in_flight;         // most requests without an answer; default: as many as max_age allows
  int32_t kept_beats;        // steps that are kept until the server has them; default: 8192
  int32_t transport;         // default: SPIKESERVE_ROBOT_AUTO
  int32_t redundancy;        // how often each datagram is sent, 1 or 2; default: 1
  int32_t tls;               // 1: encrypts, with the system's authorities
  const spikeserve_robot_action_t* neutral;  // NULL: the policy's
  spikeserve_robot_fallback_t fallback;      // NULL: the neutral action
  spikeserve_robot_log_t log;                // NULL: to the standard error
  void* context;                             // of both functions
} spikeserve_robot_options_t;

// How an episode has ended, in the terms of Gymnasium.
typedef struct {
  double reward;  // for the last action
  int32_t terminated;
  int32_t truncated;
  const spikeserve_robot_action_t* executed;  // the last action, if it is another one; or NULL
} spikeserve_robot_outcome_t;

// An episode that the server has wholly.
typedef struct {
  int64_t steps;
  int64_t lost_steps;  // that a lost session has taken along
  double episode_return;
} spikeserve_robot_summary_t;

// What a robot has done. spikeserve/pilot_stats.h says what each figure is.
typedef struct {
  size_t size;            // of this structure, set by the caller
  uint64_t steps;         // all
  uint64_t by_source[4];  // steps, by source
  uint64_t entries[4];    // how often each source was entered
  uint64_t stale;
  uint64_t late_answers;
  uint64_t cancelled_calls;
  uint64_t datagram_answers;
  uint64_t reconnects;
  uint64_t reopened;
  uint64_t dropped;
  uint64_t lost_episodes;
  uint64_t unequal_returns;
  uint64_t invalid;
  uint64_t invalid_observations;
  uint64_t failures;
  double longest_gap;
  double age_p50, age_p99, age_p999;
  int32_t has_local;
  int32_t local_head_is_copy;
  int32_t sends_datagrams;
  int32_t stays_safe;  // 1: the server keeps the robot at its safe action
} spikeserve_robot_stats_t;

// Returns the version of the library: "0.2.0".
const char* spikeserve_robot_version(void);
// Fills in the defaults. `size` is that of the caller's structure.
void spikeserve_robot_options_init(spikeserve_robot_options_t* options, size_t size);

// Opens a session, and waits for it. Errors: INVALID_ARGUMENT, which names the option; those of
// OpenSession; UNAVAILABLE if no server is reached within `patience`.
int spikeserve_robot_open(const spikeserve_robot_options_t* options, spikeserve_robot_t** robot,
                          spikeserve_robot_error_t* error);

// Writes the action for an observation, at most `budget` later, and allocates no memory after the
// first steps. `reward` is for the action before. `executed` is what the robot executed there, if
// that was another action; or NULL. The action's numbers are valid until the next call. Returns
// INVALID_ARGUMENT as long as no observation was valid: the action is the neutral one then, and the
// call counts as no step.
int spikeserve_robot_step(spikeserve_robot_t* robot, const float* observation, size_t size,
                          double reward, const spikeserve_robot_action_t* executed,
                          spikeserve_robot_action_t* action, spikeserve_robot_error_t* error);

// Waits for an answer that the next step may execute. Returns 1 if there is one, or 0 at the end of
// `timeout`. A robot that stands still calls it after its first step.
int spikeserve_robot_wait_ready(spikeserve_robot_t* robot, double timeout);

// Ends the episode without waiting; the next step begins another one. Returns the number of the
// episode, from 0.
uint64_t spikeserve_robot_end_episode(spikeserve_robot_t* robot,
                                      const spikeserve_robot_outcome_t* outcome);
// Waits until the server has an episode, and writes its summary, once. Returns DEADLINE_EXCEEDED if
// it has not after `timeout`: call again. Other errors are final: UNAVAILABLE if the session was
// lost; NOT_FOUND if no such episode has ended, its summary was taken, or 4,096 have ended since.
int spikeserve_robot_wait_summary(spikeserve_robot_t* robot, uint64_t episode, double timeout,
                                  spikeserve_robot_summary_t* summary,
                                  spikeserve_robot_error_t* error);

// Writes what the robot has done so far to `stats`, whose `size` is set.
void spikeserve_robot_stats(const spikeserve_robot_t* robot, spikeserve_robot_stats_t* stats);
// Writes the id of the session at the server, which changes if the server has lost it, and a NUL.
// Returns its length, of which `size` - 1 bytes were written at most.
size_t spikeserve_robot_session_id(const spikeserve_robot_t* robot, char* id, size_t size);

// Waits until the server has the ends of all episodes, for `close_timeout` at most, closes the
// session and frees the robot. NULL: does nothing.
void spikeserve_robot_close(spikeserve_robot_t* robot);

// Returns "fresh", "held", "local" or "safe"; NULL for another number.
const char* spikeserve_robot_source_name(int32_t source);

#ifdef __cplusplus
}
#endif

#endif  // SPIKESERVE_ROBOT_H_
