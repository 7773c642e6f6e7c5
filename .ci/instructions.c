/* Plugin of QEMU 7 and 8 that counts the guest's instructions, all threads together: at each getpgid(MARK + n) it writes
 * n and the count into the file of its argument. Declared here, as Debian ships no header. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

enum { GETPGID = 155, MARK = 1 << 29 };
typedef uint64_t u64;
struct block;
size_t qemu_plugin_tb_n_insns(const struct block *);
void qemu_plugin_register_vcpu_tb_trans_cb(u64, void (*)(u64, struct block *));
void qemu_plugin_register_vcpu_tb_exec_cb(struct block *, void (*)(unsigned, void *), int, void *);
void qemu_plugin_register_vcpu_syscall_cb(u64, void (*)(u64, unsigned, int64_t, u64, u64, u64, u64, u64, u64, u64, u64));

int qemu_plugin_version = 1;
static u64 count;
static FILE *out;

static void run(unsigned cpu, void *size) { __atomic_fetch_add(&count, (uintptr_t)size, __ATOMIC_RELAXED); }

static void translate(u64 id, struct block *block) {
    qemu_plugin_register_vcpu_tb_exec_cb(block, run, 0, (void *)qemu_plugin_tb_n_insns(block));
}

static void call(u64 id, unsigned cpu, int64_t number, u64 a, u64 b, u64 c, u64 d, u64 e, u64 f, u64 g, u64 h) {
    if (number == GETPGID && a >= MARK) {
        fprintf(out, "%" PRIu64 " %" PRIu64 "\n", a - MARK, count);
        fflush(out);
    }
}

int qemu_plugin_install(u64 id, const void *info, int argc, char **argv) {
    out = argc == 1 && strchr(argv[0], '=') ? fopen(strchr(argv[0], '=') + 1, "w") : NULL;
    if (!out) return 1;
    qemu_plugin_register_vcpu_tb_trans_cb(id, translate);
    qemu_plugin_register_vcpu_syscall_cb(id, call);
    return 0;
}
