/* Flies a robot, as the lines of its standard input say, and answers each with a line of JSON. Used by
 * tests/python/pilot/robot_programs.py, as are fly.rs and fly.go. Words are separated by one space.
 *
 *   open SERVERS POLICY SESSION PERIOD MAX_AGE LOCAL_POLICY ACTION TRANSPORT HOLD    LOCAL_POLICY: - for none, "" for the server's;
 *                                                        ACTION: the robot's own for Box, or - for none; TRANSPORT, HOLD: numbers
 *   beat REWARD BY OPERATOR N OBSERVATION... EXECUTED...    BY: a number; OPERATOR: who chose, or - for nobody
 *   end REWARD TERMINATED
 *   summary EPISODE TIMEOUT
 *   wait TIMEOUT
 *   session | stats | close
 */
#include <spikeserve_robot.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST 64

static spikeserve_robot_t* robot;
static spikeserve_robot_error_t error;
static float own;

static const char* word(void) {
  const char* next = strtok(NULL, " \n");
  return next != NULL ? next : "";
}

static double number(void) { return strtod(word(), NULL); }

static int own_action(void* context, const float* observation, size_t size, spikeserve_robot_action_t* action) {
  (void)observation;
  action->continuous = context;
  action->size = 1;
  return size > 0 ? 0 : 1;
}

static void log_line(void* context, const char* line) {
  (void)context;
  fprintf(stderr, "robot: %s\n", line);
}

static void fail(void) {
  printf("{\"error\": \"");
  for (const char* c = error.message; *c != '\0'; ++c) printf(*c == '"' || *c == '\\' ? "\\%c" : "%c", *c);
  printf("\", \"code\": %d}\n", (int)error.code);
}

static void open_robot(void) {
  spikeserve_robot_options_t options;
  spikeserve_robot_options_init(&options, sizeof options);
  options.servers = word();
  options.policy = word();
  options.session = word();
  options.period = number();
  options.max_age = number();
  options.local_policy = word();
  if (strcmp(options.local_policy, "-") == 0) options.local_policy = NULL;
  if (options.local_policy != NULL && strcmp(options.local_policy, "\"\"") == 0) options.local_policy = "";
  const char* action = word();
  if (strcmp(action, "-") != 0) {
    own = strtof(action, NULL);
    options.fallback = own_action;
    options.context = &own;
  }
  options.transport = (int32_t)number();
  options.hold_beats = (int32_t)number();
  options.log = log_line;
  if (spikeserve_robot_open(&options, &robot, &error) == 0) {
    puts("{}");
  } else {
    fail();
  }
}

static void beat(void) {
  const double reward = number();
  const int32_t by = (int32_t)number();
  const char* operator_id = word();
  const size_t size = (size_t)number();
  float numbers[MOST];
  size_t count = 0;
  for (const char* next = word(); *next != '\0' && count < MOST; next = word()) numbers[count++] = strtof(next, NULL);
  const spikeserve_robot_action_t executed = {
      .continuous = numbers + size,
      .size = count - size,
      .by = by,
      .operator_id = strcmp(operator_id, "-") == 0 ? NULL : operator_id,
  };
  spikeserve_robot_action_t action;
  if (spikeserve_robot_step(robot, numbers, size, reward, count > size ? &executed : NULL, &action, &error) != 0) {
    fail();
    return;
  }
  printf("{\"source\": \"%s\", \"age\": %.9g, \"beat\": %llu, \"action\": ", spikeserve_robot_source_name(action.source),
         action.age, (unsigned long long)action.step);
  if (action.size == 0) printf("%lld}\n", (long long)action.discrete);
  for (size_t i = 0; i < action.size; ++i) {
    printf("%s%.9g%s", i == 0 ? "[" : ", ", (double)action.continuous[i], i + 1 == action.size ? "]}\n" : "");
  }
}

static void end(void) {
  spikeserve_robot_outcome_t outcome = {.reward = number()};
  outcome.terminated = number() != 0;
  printf("{\"episode\": %llu}\n", (unsigned long long)spikeserve_robot_end_episode(robot, &outcome));
}

static void summary(void) {
  const uint64_t episode = (uint64_t)number();
  spikeserve_robot_summary_t ended;
  const int code = spikeserve_robot_wait_summary(robot, episode, number(), &ended, &error);
  if (code == SPIKESERVE_ROBOT_OK) {
    printf("{\"steps\": %lld, \"lost_steps\": %lld, \"episode_return\": %.17g}\n", (long long)ended.steps,
           (long long)ended.lost_steps, ended.episode_return);
  } else if (code == SPIKESERVE_ROBOT_DEADLINE_EXCEEDED) {
    puts("{}");
  } else {
    fail();
  }
}

static void count(const char* name, uint64_t value) { printf("\"%s\": %llu, ", name, (unsigned long long)value); }

static void stats(void) {
  spikeserve_robot_stats_t s = {.size = sizeof s};
  spikeserve_robot_stats(robot, &s);
  putchar('{');
  count("beats", s.steps);
  for (int32_t i = 0; i < 4; ++i) count(spikeserve_robot_source_name(i), s.by_source[i]);
  count("datagram_answers", s.datagram_answers);
  count("sends_datagrams", (uint64_t)s.sends_datagrams);
  count("reconnects", s.reconnects);
  count("reopened", s.reopened);
  count("dropped", s.dropped);
  count("lost_episodes", s.lost_episodes);
  count("unequal_returns", s.unequal_returns);
  count("invalid", s.invalid);
  count("failures", s.failures);
  count("has_local", (uint64_t)s.has_local);
  count("stays_safe", (uint64_t)s.stays_safe);
  printf("\"age_p50\": %g, \"age_p99\": %g, \"age_p999\": %g}\n", s.age_p50, s.age_p99, s.age_p999);
}

int main(void) {
  static char line[4096];
  while (fgets(line, sizeof line, stdin) != NULL) {
    const char* what = strtok(line, " \n");
    if (strcmp(what, "open") == 0) open_robot();
    if (strcmp(what, "beat") == 0) beat();
    if (strcmp(what, "end") == 0) end();
    if (strcmp(what, "summary") == 0) summary();
    if (strcmp(what, "wait") == 0) printf("%s\n", spikeserve_robot_wait_ready(robot, number()) ? "true" : "false");
    if (strcmp(what, "stats") == 0) stats();
    if (strcmp(what, "session") == 0) {
      char id[64];
      spikeserve_robot_session_id(robot, id, sizeof id);
      printf("\"%s\"\n", id);
    }
    if (strcmp(what, "close") == 0) {
      spikeserve_robot_close(robot);
      puts("{}");
    }
    fflush(stdout);
  }
  return 0;
}
