/* A plugin for qemu-user (API 1, QEMU 7.2): counts the instructions that an emulated program executes, by stage.
 *
 *   qemu-arm -plugin instruction_counter.so,out=counts.json PROGRAM
 *
 * The program says which stage begins by the system call umask(stage << 9 | 022): it cannot fail, costs a few hundred
 * instructions from Python, and the kernel looks at the low nine bits alone. Stages are 1 to 63; 0 is before the first.
 * Only what user space executes is counted. Threads share the counter: with several, counts are good to about one in
 * a hundred, and belong to the stage that the marking thread is in.
 */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

/* Debian packages no header for plugins: these are the few declarations that are used. */
typedef uint64_t qemu_plugin_id_t;
typedef struct {
    const char *target_name;
    struct { int min, cur; } version;
    bool system_emulation;
} qemu_info_t;
struct qemu_plugin_tb;
enum { ADD_U64 = 0 };
extern void qemu_plugin_register_vcpu_tb_trans_cb(qemu_plugin_id_t, void (*)(qemu_plugin_id_t, struct qemu_plugin_tb *));
extern void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb *, int, void *, uint64_t);
extern size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *);
extern void qemu_plugin_register_vcpu_syscall_cb(qemu_plugin_id_t,
    void (*)(qemu_plugin_id_t, unsigned, int64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t));
extern void qemu_plugin_register_atexit_cb(qemu_plugin_id_t, void (*)(qemu_plugin_id_t, void *), void *);
#define EXPORT __attribute__((visibility("default")))
EXPORT int qemu_plugin_version = 1;

enum { UMASK = 60, STAGES = 64 };
static uint64_t executed, counted, instructions[STAGES], entries[STAGES];
static unsigned stage;
static FILE *out;

static void translated(qemu_plugin_id_t id, struct qemu_plugin_tb *block)
{
    (void)id;
    qemu_plugin_register_vcpu_tb_exec_inline(block, ADD_U64, &executed, qemu_plugin_tb_n_insns(block));
}

static void begin(unsigned next)
{
    instructions[stage] += executed - counted;
    counted = executed;
    stage = next;
    entries[stage]++;
}

static void called(qemu_plugin_id_t id, unsigned cpu, int64_t number, uint64_t mask, uint64_t a2, uint64_t a3,
                   uint64_t a4, uint64_t a5, uint64_t a6, uint64_t a7, uint64_t a8)
{
    (void)id, (void)cpu, (void)a2, (void)a3, (void)a4, (void)a5, (void)a6, (void)a7, (void)a8;
    if (number == UMASK && mask >> 9 && mask >> 9 < STAGES)
        begin(mask >> 9);
}

static void ended(qemu_plugin_id_t id, void *data)
{
    (void)id, (void)data;
    begin(stage);
    fprintf(out, "{\"total\": %llu, \"stages\": [", (unsigned long long)executed);
    for (unsigned i = 0; i < STAGES; i++)
        fprintf(out, "%s[%llu, %llu]", i ? ", " : "", (unsigned long long)instructions[i], (unsigned long long)entries[i]);
    fprintf(out, "]}\n");
    fclose(out);
}

EXPORT int qemu_plugin_install(qemu_plugin_id_t id, const qemu_info_t *info, int argc, char **argv)
{
    (void)info;
    out = stderr;
    for (int i = 0; i < argc; i++)
        if (!strncmp(argv[i], "out=", 4))
            out = fopen(argv[i] + 4, "w");
    if (!out)
        return 1;
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    qemu_plugin_register_vcpu_syscall_cb(id, called);
    qemu_plugin_register_atexit_cb(id, ended, NULL);
    return 0;
}
