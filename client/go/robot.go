// Package robot flies one robot: every control step has an action in time, whatever the link to the server does.
// It calls libspikeserve_robot, whose header, spikeserve_robot.h, has the details.
//
//	flown, err := robot.Open(robot.Options{Servers: "127.0.0.1:50051", Policy: "pendulum", Period: 0.02})
//	step, err := flown.Step([]float32{1, 0, 0}, 0, nil)
//	fmt.Println(step.Action, step.Source)
//	flown.EndEpisode(robot.Outcome{Truncated: true})
//	flown.Close()
package robot

/*
#cgo pkg-config: spikeserve_robot
#include <stdlib.h>
#include <spikeserve_robot.h>

extern int spikeserveGoFallback(void* context, float* observation, size_t size, spikeserve_robot_action_t* action);
extern void spikeserveGoLog(void* context, char* line);

// What C keeps for a robot: Go's memory may move, and C may not keep it.
typedef struct {
  uintptr_t handle;
  spikeserve_robot_t* robot;
  spikeserve_robot_options_t options;
  spikeserve_robot_error_t error;
  spikeserve_robot_action_t action;    // of the last step
  spikeserve_robot_action_t executed;  // given
  spikeserve_robot_action_t chosen;    // by the fallback
} kept_t;
*/
import "C"

import (
	"fmt"
	"runtime/cgo"
	"unsafe"
)

// Error says why a call has failed, with a status code of gRPC.
type Error struct {
	Code    int
	Message string
}

func (e *Error) Error() string { return fmt.Sprintf("%s (code %d)", e.Message, e.Code) }

// Action is in environment units: Box has a number for each element, or is nil, and Discrete is an index then. By and
// OperatorID are those of an executed one.
type Action struct {
	Discrete   int64
	Box        []float32
	By         Chooser
	OperatorID string
}

// Chooser says who chose an executed action, if it was not the policy.
type Chooser int

const (
	ByUnknown Chooser = iota
	ByPolicy
	ByOperator
	BySafetyLayer
	ByHeld
	ByLocal
	BySafe
	ByHold
)

// Transport says how the steps go to the server; Auto: as datagrams where it takes them and they come through.
type Transport int

const (
	Auto Transport = iota
	Stream
	Datagram
)

// Source says who chose an action: the fallback order.
type Source int

const (
	Fresh Source = iota
	Held
	Local
	Safe
)

func (s Source) String() string { return C.GoString(C.spikeserve_robot_source_name(C.int32_t(s))) }

// Step is the action of a control step. Action.Box is valid until the next one. Age is that of the observation, in seconds.
type Step struct {
	Action Action
	Source Source
	Age    float64
	Number uint64
}

// Outcome says how an episode has ended. Executed is the last action, if it was another one than the returned one.
type Outcome struct {
	Reward                float64
	Terminated, Truncated bool
	Executed              *Action
}

// Summary is of an episode that the server has wholly.
type Summary struct {
	Steps, LostSteps int64
	Return           float64
}

// Stats says what a robot has done: the members of spikeserve_robot_stats_t.
type Stats struct {
	Steps                                               uint64
	BySource, Entries                                   [4]uint64
	Stale, LateAnswers, CancelledCalls, DatagramAnswers uint64
	Reconnects, Reopened                                uint64
	Dropped, LostEpisodes, UnequalReturns               uint64
	Invalid, InvalidObservations, Failures              uint64
	LongestGap, AgeP50, AgeP99, AgeP999                 float64
	HasLocal, LocalHeadIsCopy, SendsDatagrams           bool
	StaysSafe                                           bool // the server keeps the robot at its safe action
}

// Options are the settings of a robot, in seconds. Nil: the default.
type Options struct {
	Servers, Policy                           string
	Session                                   *string // more fields of OpenSessionRequest, as JSON
	LocalPolicy                               *string // file for the engine on the robot; "": the server's; nil: no engine
	CA, Certificate, Key, Token               *string
	TLS                                       bool
	Period                                    float64
	Patience, Budget, MaxAge, CloseTimeout    *float64
	HoldBeats, RampBeats, InFlight, KeptBeats *int
	Transport                                 Transport
	Redundancy                                *int // how often each datagram is sent, 1 or 2
	// Returns the robot's own action for an observation, whose elements are NaN if the step has no valid one. Nil, or a
	// panic: it has failed.
	Fallback func(observation []float32) *Action
	// Takes a line when a source is entered or something fails, on a thread of the library.
	Log func(line string)
}

// Robot is for one goroutine at a time, but Stats and SessionID.
type Robot struct {
	kept    *C.kept_t
	options Options
	box     []float32
}

// Open opens a session, and waits for it.
func Open(options Options) (*Robot, error) {
	r := &Robot{kept: (*C.kept_t)(C.calloc(1, C.sizeof_kept_t)), options: options}
	r.kept.handle = C.uintptr_t(cgo.NewHandle(r))
	given := &r.kept.options
	C.spikeserve_robot_options_init(given, C.sizeof_spikeserve_robot_options_t)
	setText(&given.servers, &options.Servers)
	setText(&given.policy, &options.Policy)
	setText(&given.session, options.Session)
	setText(&given.local_policy, options.LocalPolicy)
	setText(&given.ca, options.CA)
	setText(&given.certificate, options.Certificate)
	setText(&given.key, options.Key)
	setText(&given.token, options.Token)
	given.period = C.double(options.Period)
	setTime(&given.patience, options.Patience)
	setTime(&given.budget, options.Budget)
	setTime(&given.max_age, options.MaxAge)
	setTime(&given.close_timeout, options.CloseTimeout)
	setCount(&given.hold_beats, options.HoldBeats)
	setCount(&given.ramp_beats, options.RampBeats)
	setCount(&given.in_flight, options.InFlight)
	setCount(&given.kept_beats, options.KeptBeats)
	setCount(&given.redundancy, options.Redundancy)
	given.transport = C.int32_t(options.Transport)
	given.tls = truth(options.TLS)
	given.context = unsafe.Pointer(r.kept)
	if options.Fallback != nil {
		given.fallback = (C.spikeserve_robot_fallback_t)(C.spikeserveGoFallback)
	}
	if options.Log != nil {
		given.log = (C.spikeserve_robot_log_t)(C.spikeserveGoLog)
	}
	code := C.spikeserve_robot_open(given, &r.kept.robot, &r.kept.error)
	for _, text := range []*C.char{given.servers, given.policy, given.session, given.local_policy, given.ca, given.certificate, given.key, given.token} {
		C.free(unsafe.Pointer(text))
	}
	if code != 0 {
		err := r.failure()
		r.Close()
		return nil, err
	}
	return r, nil
}

// Step returns the action for an observation. The reward is for the action before, and executed what the robot executed
// there, if that was another one. It fails, and is no step, as long as no observation was valid.
func (r *Robot) Step(observation []float32, reward float64, executed *Action) (Step, error) {
	var numbers *C.float
	if len(observation) > 0 {
		numbers = (*C.float)(&observation[0])
	}
	given, action := keep(&r.kept.executed, executed), &r.kept.action
	if C.spikeserve_robot_step(r.kept.robot, numbers, C.size_t(len(observation)), C.double(reward), given, action, &r.kept.error) != 0 {
		return Step{}, r.failure()
	}
	step := Step{Action{Discrete: int64(action.discrete)}, Source(action.source), float64(action.age), uint64(action.step)}
	if action.size > 0 {
		r.box = append(r.box[:0], unsafe.Slice((*float32)(action.continuous), int(action.size))...)
		step.Action.Box = r.box
	}
	return step, nil
}

// WaitReady waits for an answer that the next step may execute. Returns whether there is one.
func (r *Robot) WaitReady(timeout float64) bool {
	return C.spikeserve_robot_wait_ready(r.kept.robot, C.double(timeout)) == 1
}

// EndEpisode ends the episode without waiting. Returns its number, for WaitSummary.
func (r *Robot) EndEpisode(outcome Outcome) uint64 {
	given := C.spikeserve_robot_outcome_t{reward: C.double(outcome.Reward), terminated: truth(outcome.Terminated),
		truncated: truth(outcome.Truncated), executed: keep(&r.kept.executed, outcome.Executed)}
	return uint64(C.spikeserve_robot_end_episode(r.kept.robot, &given))
}

// WaitSummary returns the summary of an episode, once; nil: the server does not have it after the timeout.
func (r *Robot) WaitSummary(episode uint64, timeout float64) (*Summary, error) {
	var summary C.spikeserve_robot_summary_t
	switch C.spikeserve_robot_wait_summary(r.kept.robot, C.uint64_t(episode), C.double(timeout), &summary, &r.kept.error) {
	case C.SPIKESERVE_ROBOT_OK:
		return &Summary{int64(summary.steps), int64(summary.lost_steps), float64(summary.episode_return)}, nil
	case C.SPIKESERVE_ROBOT_DEADLINE_EXCEEDED:
		return nil, nil
	}
	return nil, r.failure()
}

// Stats returns what the robot has done so far.
func (r *Robot) Stats() Stats {
	s := C.spikeserve_robot_stats_t{size: C.sizeof_spikeserve_robot_stats_t}
	C.spikeserve_robot_stats(r.kept.robot, &s)
	stats := Stats{Steps: uint64(s.steps), Stale: uint64(s.stale), LateAnswers: uint64(s.late_answers),
		CancelledCalls:  uint64(s.cancelled_calls),
		DatagramAnswers: uint64(s.datagram_answers), SendsDatagrams: s.sends_datagrams != 0, Reconnects: uint64(s.reconnects), Reopened: uint64(s.reopened),
		Dropped: uint64(s.dropped), LostEpisodes: uint64(s.lost_episodes), UnequalReturns: uint64(s.unequal_returns),
		Invalid: uint64(s.invalid), InvalidObservations: uint64(s.invalid_observations), Failures: uint64(s.failures),
		LongestGap: float64(s.longest_gap), AgeP50: float64(s.age_p50), AgeP99: float64(s.age_p99),
		AgeP999: float64(s.age_p999), HasLocal: s.has_local != 0, LocalHeadIsCopy: s.local_head_is_copy != 0, StaysSafe: s.stays_safe != 0}
	for i := range stats.BySource {
		stats.BySource[i], stats.Entries[i] = uint64(s.by_source[i]), uint64(s.entries[i])
	}
	return stats
}

// SessionID returns the id of the session at the server, which changes if the server has lost it.
func (r *Robot) SessionID() string {
	var id [128]C.char
	C.spikeserve_robot_session_id(r.kept.robot, &id[0], C.size_t(len(id)))
	return C.GoString(&id[0])
}

// Close waits until the server has the ends of all episodes, for CloseTimeout at most, and frees the robot. Call it once.
func (r *Robot) Close() {
	C.spikeserve_robot_close(r.kept.robot)
	for _, kept := range []*C.spikeserve_robot_action_t{&r.kept.executed, &r.kept.chosen} {
		C.free(unsafe.Pointer(kept.continuous))
		C.free(unsafe.Pointer(kept.operator_id))
	}
	cgo.Handle(r.kept.handle).Delete()
	C.free(unsafe.Pointer(r.kept))
	r.kept = nil
}

func (r *Robot) failure() error {
	return &Error{int(r.kept.error.code), C.GoString(&r.kept.error.message[0])}
}

// keep copies an action to C's memory, which it allocates.
func keep(to *C.spikeserve_robot_action_t, action *Action) *C.spikeserve_robot_action_t {
	if action == nil {
		return nil
	}
	if C.size_t(len(action.Box)) > to.size {
		C.free(unsafe.Pointer(to.continuous))
		to.continuous = (*C.float)(C.malloc(C.size_t(len(action.Box)) * 4))
	}
	to.discrete, to.size = C.int64_t(action.Discrete), C.size_t(len(action.Box))
	copy(unsafe.Slice((*float32)(to.continuous), len(action.Box)), action.Box)
	C.free(unsafe.Pointer(to.operator_id))
	to.by, to.operator_id = C.int32_t(action.By), nil
	if action.OperatorID != "" {
		to.operator_id = C.CString(action.OperatorID)
	}
	return to
}

func setText(to **C.char, text *string) {
	if text != nil {
		*to = C.CString(*text)
	}
}

func setTime(to *C.double, seconds *float64) {
	if seconds != nil {
		*to = C.double(*seconds)
	}
}

func setCount(to *C.int32_t, count *int) {
	if count != nil {
		*to = C.int32_t(*count)
	}
}

func truth(is bool) C.int32_t {
	if is {
		return 1
	}
	return 0
}

//export spikeserveGoFallback
func spikeserveGoFallback(context unsafe.Pointer, observation *C.float, size C.size_t, action *C.spikeserve_robot_action_t) (failed C.int) {
	kept := (*C.kept_t)(context)
	failed = 1
	defer func() { _ = recover() }()
	r := cgo.Handle(kept.handle).Value().(*Robot)
	if chosen := r.options.Fallback(unsafe.Slice((*float32)(observation), int(size))); chosen != nil {
		*action = *keep(&kept.chosen, chosen)
		failed = 0
	}
	return failed
}

//export spikeserveGoLog
func spikeserveGoLog(context unsafe.Pointer, line *C.char) {
	defer func() { _ = recover() }()
	cgo.Handle((*C.kept_t)(context).handle).Value().(*Robot).options.Log(C.GoString(line))
}
