//! Flies one robot: every control step has an action in time, whatever the link to the server does.
//! On libspikeserve_robot; its header, spikeserve_robot.h, has the details.
//!
//! ```no_run
//! use spikeserve_robot::{Options, Outcome, Robot};
//! let servers = "127.0.0.1:50051".into();
//! let options = Options { servers, policy: "pendulum".into(), period: 0.02, ..Options::default() };
//! let mut robot = Robot::open(options)?;
//! let step = robot.step(&[1.0, 0.0, 0.0], 0.0, None)?;
//! println!("{:?} from {:?}", step.action, step.source);
//! robot.end_episode(Outcome { truncated: true, ..Outcome::default() });
//! # Ok::<(), spikeserve_robot::Error>(())
//! ```
#[rustfmt::skip]
mod ffi;

pub use ffi::{Stats, Summary};
use std::ffi::{CStr, CString};
use std::os::raw::{c_char, c_int, c_void};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::ptr::{null, null_mut};

/// Why a call has failed: a status code of gRPC, and what was expected and received.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    pub code: i32,
    pub message: String,
}

impl std::fmt::Display for Error {
    fn fmt(&self, out: &mut std::fmt::Formatter) -> std::fmt::Result {
        write!(out, "{} (code {})", self.message, self.code)
    }
}

impl std::error::Error for Error {}

/// An action in environment units: an index of a Discrete space, or a number for each element of a Box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action<'a> {
    Discrete(i64),
    Box(&'a [f32]),
}

/// Who chose an action: the fallback order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[rustfmt::skip]
pub enum Source { Fresh, Held, Local, Safe }

/// Who chose an executed action, if it was not the policy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[rustfmt::skip]
pub enum Chooser { #[default] Unknown, Policy, Operator, SafetyLayer, Held, Local, Safe, Hold }

/// An executed action, and who chose it, with the name of an operator. An action alone is one of an unknown chooser.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Executed<'a> {
    pub action: Action<'a>,
    pub by: Chooser,
    pub operator_id: &'a CStr,
}

impl<'a> From<Action<'a>> for Executed<'a> {
    fn from(action: Action<'a>) -> Self {
        Executed { action, by: Chooser::Unknown, operator_id: Default::default() }
    }
}

/// How the steps go to the server; `Auto`: as datagrams where it takes them and they come through.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[rustfmt::skip]
pub enum Transport { #[default] Auto, Stream, Datagram }

/// The action of a control step, with the age of its observation in seconds.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    pub action: Action<'a>,
    pub source: Source,
    pub age: f64,
    pub number: u64,
}

/// How an episode has ended. `executed` is the last action, if it was another than the returned one.
#[derive(Clone, Copy, Debug, Default)]
pub struct Outcome<'a> {
    pub reward: f64,
    pub terminated: bool,
    pub truncated: bool,
    pub executed: Option<Executed<'a>>,
}

/// Returns the robot's own action for an observation, whose elements are NaN if the step has no valid one:
/// the numbers of a Box, or one number, the index. None, or a panic: it has failed.
pub type Fallback = Box<dyn FnMut(&[f32]) -> Option<Vec<f32>> + Send>;
/// Takes a line when a source is entered or something fails, on a thread of the library.
pub type Log = Box<dyn FnMut(&str) + Send>;

/// The settings of a robot, in seconds. None: the default.
#[derive(Default)]
#[rustfmt::skip]
pub struct Options {
    pub servers: String,
    pub policy: String,
    pub session: Option<String>, // more fields of OpenSessionRequest, as JSON
    pub local_policy: Option<String>, // file for the engine on the robot; "": the server's; None: no engine
    pub ca: Option<String>, pub certificate: Option<String>, pub key: Option<String>, pub token: Option<String>,
    pub tls: bool,
    pub patience: Option<f64>,
    pub period: f64,
    pub budget: Option<f64>, pub max_age: Option<f64>, pub close_timeout: Option<f64>,
    pub hold_beats: Option<i32>, pub ramp_beats: Option<i32>,
    pub in_flight: Option<i32>, pub kept_beats: Option<i32>,
    pub transport: Transport, pub redundancy: Option<i32>,
    pub fallback: Option<Fallback>,
    pub log: Option<Log>,
}

struct Callbacks {
    fallback: Option<Fallback>,
    chosen: Vec<f32>, // by `fallback`, until its next call
    log: Option<Log>,
}

// Both may run at once: each borrows only its own fields.
#[rustfmt::skip]
unsafe extern "C" fn fallback(context: *mut c_void, observation: *const f32, size: usize, action: *mut ffi::Action) -> c_int {
    let callbacks = context as *mut Callbacks;
    let (function, chosen) = (&mut (*callbacks).fallback, &mut (*callbacks).chosen);
    let observation = std::slice::from_raw_parts(observation, size);
    match catch_unwind(AssertUnwindSafe(|| function.as_mut().and_then(|function| function(observation)))) {
        Ok(Some(numbers)) => *chosen = numbers,
        _ => return 1,
    }
    *action = to_c(Some(Action::Box(chosen).into()));
    // `as` would make an index of NaN and of fractions; -1 belongs to no space.
    (*action).discrete = chosen.first().filter(|index| index.fract() == 0.0).map_or(-1, |index| *index as i64);
    0
}

unsafe extern "C" fn log(context: *mut c_void, line: *const c_char) {
    let function = &mut (*(context as *mut Callbacks)).log;
    let line = CStr::from_ptr(line).to_string_lossy();
    let _ = catch_unwind(AssertUnwindSafe(|| function.as_mut().map(|function| function(&line))));
}

fn to_c(executed: Option<Executed>) -> ffi::Action {
    let Executed { action, by, operator_id } = executed.unwrap_or(Action::Discrete(0).into());
    let (discrete, continuous, size) = match action {
        Action::Discrete(index) => (index, null(), 0),
        Action::Box(numbers) => (0, numbers.as_ptr(), numbers.len()),
    };
    let (by, operator_id) = (by as i32, operator_id.as_ptr());
    ffi::Action { discrete, continuous, size, source: 0, age: 0.0, step: 0, by, operator_id }
}

/// Calls `function`, which fills in an error.
fn call(function: impl FnOnce(&mut ffi::Error) -> c_int) -> Result<(), Error> {
    let mut error = ffi::Error { code: 0, message: [0; 508] };
    match function(&mut error) {
        0 => Ok(()),
        code => {
            let message = unsafe { CStr::from_ptr(error.message.as_ptr()) }.to_string_lossy().into_owned();
            Err(Error { code, message })
        }
    }
}

/// A robot. Dropping it waits until the server has the ends of all episodes, for `close_timeout` at most.
pub struct Robot {
    robot: *mut ffi::Robot,
    callbacks: *mut Callbacks, // of `robot`
}

unsafe impl Send for Robot {}
unsafe impl Sync for Robot {} // what takes &self may run on any thread

impl Robot {
    /// Opens a session, and waits for it.
    pub fn open(o: Options) -> Result<Robot, Error> {
        let mut given: ffi::Options = unsafe { std::mem::zeroed() };
        unsafe { ffi::spikeserve_robot_options_init(&mut given, std::mem::size_of::<ffi::Options>()) };
        let texts = [Some(o.servers), Some(o.policy), o.session, o.local_policy, o.ca, o.certificate, o.key, o.token];
        let texts = texts.map(|text| text.map(|text| CString::new(text.replace('\0', " ")).unwrap_or_default()));
        given.texts = [0, 1, 2, 3, 4, 5, 6, 7].map(|i: usize| texts[i].as_ref().map_or(null(), |text| text.as_ptr()));
        let times = [o.patience, Some(o.period), o.budget, o.max_age, o.close_timeout];
        given.times = times.map(|time| time.unwrap_or(-1.0));
        let transport = Some(o.transport as i32);
        given.counts = [o.hold_beats, o.ramp_beats, o.in_flight, o.kept_beats, transport, o.redundancy]
            .map(|count| count.unwrap_or(-1));
        given.tls = o.tls.into();
        given.fallback = o.fallback.is_some().then(|| fallback as ffi::Fallback);
        given.log = o.log.is_some().then(|| log as ffi::Log);
        let callbacks = Box::into_raw(Box::new(Callbacks { fallback: o.fallback, chosen: Vec::new(), log: o.log }));
        given.context = callbacks as *mut c_void;
        let mut robot = Robot { robot: null_mut(), callbacks };
        call(|error| unsafe { ffi::spikeserve_robot_open(&given, &mut robot.robot, error) })?;
        Ok(robot)
    }

    /// Returns the action for an observation. `reward` is for the action before, `executed` what the robot
    /// executed there, if that was another one. It fails, and is no step, as long as no observation was valid.
    pub fn step(&mut self, observation: &[f32], reward: f64, executed: Option<Executed>) -> Result<Step<'_>, Error> {
        let given = to_c(executed);
        let executed = if executed.is_some() { &given as *const ffi::Action } else { null() };
        let (numbers, size) = (observation.as_ptr(), observation.len());
        let mut action = to_c(None);
        call(|error| unsafe {
            ffi::spikeserve_robot_step(self.robot, numbers, size, reward, executed, &mut action, error)
        })?;
        let chosen = match action.size {
            0 => Action::Discrete(action.discrete),
            size => Action::Box(unsafe { std::slice::from_raw_parts(action.continuous, size) }),
        };
        let source = [Source::Fresh, Source::Held, Source::Local, Source::Safe][action.source as usize];
        Ok(Step { action: chosen, source, age: action.age, number: action.step })
    }

    /// Waits for an answer that the next step may execute. Returns whether there is one.
    pub fn wait_ready(&mut self, timeout: f64) -> bool {
        unsafe { ffi::spikeserve_robot_wait_ready(self.robot, timeout) == 1 }
    }

    /// Ends the episode without waiting. Returns its number, for `wait_summary`.
    pub fn end_episode(&mut self, outcome: Outcome) -> u64 {
        let given = to_c(outcome.executed);
        let executed = if outcome.executed.is_some() { &given as *const ffi::Action } else { null() };
        let terminated_truncated = [outcome.terminated.into(), outcome.truncated.into()];
        let outcome = ffi::Outcome { reward: outcome.reward, terminated_truncated, executed };
        unsafe { ffi::spikeserve_robot_end_episode(self.robot, &outcome) }
    }

    /// Returns the summary of an episode, once, or None if the server does not have it after `timeout`.
    pub fn wait_summary(&mut self, episode: u64, timeout: f64) -> Result<Option<Summary>, Error> {
        let mut summary = Summary::default();
        let waited = call(|error| unsafe {
            ffi::spikeserve_robot_wait_summary(self.robot, episode, timeout, &mut summary, error)
        });
        match waited {
            Err(error) if error.code == 4 => Ok(None), // DEADLINE_EXCEEDED
            waited => waited.map(|()| Some(summary)),
        }
    }

    /// Returns what the robot has done so far.
    pub fn stats(&self) -> Stats {
        let mut stats = Stats { size: std::mem::size_of::<Stats>(), ..Stats::default() };
        unsafe { ffi::spikeserve_robot_stats(self.robot, &mut stats) };
        stats
    }

    /// Returns the id of the session at the server, which changes if the server has lost it.
    pub fn session_id(&self) -> String {
        let mut id = [0; 128];
        unsafe { ffi::spikeserve_robot_session_id(self.robot, id.as_mut_ptr(), id.len()) };
        unsafe { CStr::from_ptr(id.as_ptr()) }.to_string_lossy().into_owned()
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        unsafe { ffi::spikeserve_robot_close(self.robot) };
        drop(unsafe { Box::from_raw(self.callbacks) });
    }
}
