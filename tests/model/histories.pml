/* Models how a robot tells its session what it has executed, while the server loses the last steps of an ASYNC session.
 *
 * The entry of step k in the journal has the action that was executed at step k - 1. So a server that has lost step k
 * does not know what the robot did at step k - 1, and the robot, which has an answer for step k, has told it once.
 * A history has the beats that the server expects, and one before them. Of beats that the robot has not kept it has
 * the rewards, and the context starts behind them.
 *
 * Checked, by assertions:
 * - a server that appends a step knows what was executed at the step before, or the context starts there;
 * - a robot that was told what the server expects is not refused again.
 *
 * Each of these is a protocol that is not enough, so that the check must fail:
 * -DOWN_ACTION     the server takes a history that begins at the expected step, and its own action before it
 * -DSKIPPED_KNOWN  it does so only behind skipped rewards, which may be of steps that it has
 * -DBEGIN_AT_NEXT  a history begins at the expected step
 * -DNO_GAP         a history begins at the first beat that is kept, although what was executed before it is not
 *
 * run_model.py runs SPIN on this file. Behind each transition stands the function that implements it. */

#define STEPS 7
#define KEPT 3         /* BeatLog::kept_, with the newest beat */
#define MOST_LOSSES 3

byte stored = 0;  /* steps in the journal */
byte copy = 0;    /* steps that the server has */
byte losses = 0;

byte beats = 0;   /* of the robot */
byte acked = 0;   /* the step that the server expects, as the robot knows */
bool told = false; /* the server has refused what the robot would send, and nothing has changed since */

#define MOST(a, b) ((a) > (b) -> (a) : (b))

/* A request that may be on its way while another one is answered. */
chan late = [1] of { byte, byte, byte };

inline fill() {  /* BeatLog::HistoryBegin(), Episode._begin() */
  reach = acked;
#ifdef BEGIN_AT_NEXT
  begin = acked;
#else
  begin = (acked > 0 -> acked - 1 : 0);
#endif
  kept = (beats > KEPT -> beats - KEPT : 0);
  if
  :: kept > begin ->
    begin = kept
#ifndef NO_GAP
    ;
    if
    :: begin == acked -> begin++
    :: else
    fi
#endif
  :: else
  fi;
  reach = (begin < reach -> begin : reach)  /* the first step of its skipped rewards, or its first beat */
}

/* AppendBeats(), CheckPlace(): beats `begin` to `step` - 1, rewards from `reach` on, and the decision `step`. */
inline take(is_new) {
  if
  :: step < copy -> acked = copy
  :: step >= copy && (reach > copy
#ifndef OWN_ACTION
     || (begin == copy && copy > 0 && step > copy
#ifdef SKIPPED_KNOWN
         && reach == begin
#endif
     )
#endif
     ) ->
    assert(!(is_new && told && acked == copy));
    told = is_new;
    acked = copy
  :: else ->
    if
    :: step > copy -> assert(copy == 0 || begin < copy || begin > copy)  /* begin > copy: the context starts there */
    :: else  /* a decision without a history, or behind known beats, has the executed action before it */
    fi;
    copy = step + 1;
    acked = copy;
    told = false
  fi
}

active proctype Robot() {
  byte begin, reach, step, kept;
  do
  :: atomic { beats < STEPS && beats - acked < KEPT + 2 -> beats++; told = false }
  :: atomic { beats > 0 -> fill(); step = beats - 1; take(true) }
  :: atomic { beats > 0 && empty(late) -> fill(); step = beats - 1; late!begin, reach, step }
  :: atomic { late?begin, reach, step; take(false) }
  od
}

active proctype Store() {
  do
  :: atomic { stored < copy -> stored++ }  /* SessionJournal::OnWritten() */
  :: atomic { losses < MOST_LOSSES && stored < copy -> losses++; copy = stored; told = false }
  od
}
